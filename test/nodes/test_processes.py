import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import node_process
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

pytestmark = [pytest.mark.ros, pytest.mark.process]

PARENT = """
import sys, time
from pathlib import Path
from nics_drl_bridge.nodes.processes import NodeProcess
with NodeProcess("command_gate", Path(sys.argv[1]), {}, int(sys.argv[2])) as node:
    print(node.pid, flush=True)
    sys.stdin.read()
"""


def alive(pid):
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def test_a_node_dies_with_its_parent_however_that_dies(tmp_path, domain_id, meet):
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(tmp_path), str(domain_id)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        child = int(parent.stdout.readline())
        assert alive(child)
        parent.kill()
        parent.wait()
        meet(domain_id).until(lambda: not alive(child), "the end of the child")
    finally:
        parent.kill()
        parent.communicate()


def test_leaving_the_block_ends_a_node_that_hangs(
    tmp_path, domain_id, meet, monkeypatch
):
    peer = meet(domain_id)
    monkeypatch.setattr(node_process, "PATIENCE_S", 0.5)
    with NodeProcess("command_gate", tmp_path / "hangs", {}, domain_id) as node:
        # One that still starts has no handler yet: the first signal ends it, though held.
        peer.until(lambda: "running" in node.log.read_text("utf-8"), "the gate")
        os.kill(node.pid, signal.SIGSTOP)
    assert not alive(node.pid)
    assert node.close() == -signal.SIGKILL


def test_a_node_that_ended_by_itself_is_named_with_its_code_and_log(
    tmp_path, domain_id, meet, monkeypatch
):
    """In a folder with modules of its own, as that of a model may have, which are not loaded."""
    canary = tmp_path / "canary"
    for name in ("yaml", "numpy", "numba", "rclpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(canary)!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    wrong = {"policy": "dynamic_widow"}
    with NodeProcess("policy_node", tmp_path / "log", wrong, domain_id) as node:
        meet(domain_id).until(lambda: node._process.poll() is not None, "its end")
        expected = (
            "policy_node ended with code 2: unknown policy 'dynamic_widow'; did you mean "
            f"'dynamic_window'? (its log is {node.log})."
        )
        with pytest.raises(BackendError, match=f"^{re.escape(expected)}$"):
            node.check()
    assert not canary.exists()


def test_the_domain_id_is_the_environments_or_drawn(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert free_domain_id() == 42
    monkeypatch.delenv("ROS_DOMAIN_ID")
    drawn = {free_domain_id() for _ in range(50)}
    assert len(drawn) > 10
    assert all(0 < domain_id < 102 for domain_id in drawn)


@pytest.mark.parametrize("given", ["seven", "-1", "233"])
def test_a_wrong_domain_id_of_the_environment_is_one_sentence(monkeypatch, given):
    monkeypatch.setenv("ROS_DOMAIN_ID", given)
    with pytest.raises(ConfigError, match=f"ROS_DOMAIN_ID is '{given}'"):
        free_domain_id()
