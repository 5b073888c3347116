"""The policies of sros2 allow what the nodes do, and nothing besides."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from nics_drl_bridge.config import share_folder

NODES = ("simulator_node", "middleware_node", "policy_node", "command_gate")
FOLDER = share_folder() / "config" / "sros2"


def read_rights(file: str) -> dict[str, set[tuple[str, str]]]:
    """Return for each node pairs of what it may do and the full name."""
    policy = ElementTree.parse(FOLDER / file).getroot()
    assert (policy.tag, policy.get("version")) == ("policy", "0.2.0")
    rights: dict[str, set[tuple[str, str]]] = {}
    for enclave in policy.iterfind("enclaves/enclave"):
        for profile in enclave.iterfind("profiles/profile"):
            node = str(profile.get("node"))
            assert (enclave.get("path"), profile.get("ns")) == (f"/{node}", "/")
            own = rights.setdefault(node, set())
            for group in profile:
                assert set(group.attrib.values()) == {"ALLOW"}
                for name in group:
                    text = str(name.text)
                    full = text.replace("~", f"/{node}") if text[0] == "~" else text
                    whole = full if full.startswith("/") else f"/{full}"
                    own |= {(what, whole) for what in group.attrib}
    return rights


@pytest.mark.parametrize(
    ("file", "topic", "sole"),
    [
        ("policy.xml", "/cmd_vel", "command_gate"),
        ("policy.xml", "/cmd_vel_raw", "policy_node"),
        ("recording.xml", "/cmd_vel", "record_node"),
    ],
)
def test_only_one_node_may_publish_commands(file, topic, sole):
    rights = read_rights(file)
    assert {node for node in rights if ("publish", topic) in rights[node]} == {sole}
    assert not any("*" in name for own in rights.values() for _, name in own)


def test_nobody_but_the_operator_may_arm_or_reset_the_gate():
    rights = read_rights("policy.xml")
    for service in ("arm", "reset", "e_stop"):
        may = {
            n for n in rights if ("request", f"/command_gate/{service}") in rights[n]
        }
        assert may == {"operator"}
        assert ("reply", f"/command_gate/{service}") in rights["command_gate"]


def test_the_shares_hold_both_policies():
    assert {file.name for file in Path(FOLDER).iterdir()} == {
        "policy.xml",
        "recording.xml",
    }


@pytest.mark.parametrize("engine", ["dart_node", "mujoco_node"])
def test_an_engine_may_do_what_the_simulator_may(engine):
    rights = read_rights("policy.xml")

    def list_rights(node):
        return {(what, name.replace(f"/{node}/", "/~/")) for what, name in rights[node]}

    assert list_rights(engine) == list_rights("simulator_node")
