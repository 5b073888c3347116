import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import processes
from nics_drl_bridge.nodes.listener import holds
from nics_drl_bridge.nodes.processes import ChildProcess, NodeProcess, choose_domain_id

pytestmark = [pytest.mark.ros, pytest.mark.process]

DEADLINE_S = 90.0

HANG = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("hangs", flush=True)
time.sleep(600)
"""
PARENT = f"""
import sys
from nics_drl_bridge.nodes.processes import ChildProcess
with ChildProcess("child", [sys.executable, "-c", {HANG!r}]) as child:
    print(child.pid, flush=True)
    sys.stdin.read()
"""


def alive(pid):
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def wait_for(condition, what):
    assert holds(condition, DEADLINE_S, 0.01), what


def test_a_node_dies_with_its_parent_however_that_dies():
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        child = int(parent.stdout.readline())
        assert alive(child)
        parent.kill()
        parent.wait()
        wait_for(lambda: not alive(child), "the end of the child")
    finally:
        parent.kill()
        parent.communicate()


def test_leaving_the_block_ends_a_node_that_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "PATIENCE_S", 0.5)
    log = tmp_path / "log"
    command = [sys.executable, "-c", HANG]
    with ChildProcess("child", command, log=log) as child:
        wait_for(lambda: "hangs" in log.read_text(), "its start")
    assert not alive(child.pid)
    assert child.close() == -signal.SIGKILL


def test_a_node_that_ended_by_itself_is_named_with_its_code_and_log(
    tmp_path, domain_id, monkeypatch
):
    """In a folder with modules of its own, as that of a model may have, which are not loaded."""
    canary = tmp_path / "canary"
    for name in ("yaml", "numpy", "numba", "rclpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(canary)!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    wrong = {"robot": "differntial"}
    with NodeProcess("record_node", tmp_path / "log", wrong, domain_id) as node:
        wait_for(lambda: node.poll() is not None, "its end")
        expected = (
            "record_node ended with code 2: unknown robot 'differntial'; did you mean "
            f"'differential'? (or give the path of a YAML file). (its log is {node.log})."
        )
        with pytest.raises(BackendError, match=f"^{re.escape(expected)}$"):
            node.check()
    assert not canary.exists()


def test_the_domain_id_is_the_environments_or_drawn(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert choose_domain_id() == 42
    monkeypatch.delenv("ROS_DOMAIN_ID")
    drawn = {choose_domain_id() for _ in range(50)}
    assert len(drawn) > 10
    assert all(0 < domain_id < 102 for domain_id in drawn)


@pytest.mark.parametrize("given", ["seven", "-1", "233"])
def test_a_wrong_domain_id_of_the_environment_is_one_sentence(monkeypatch, given):
    monkeypatch.setenv("ROS_DOMAIN_ID", given)
    with pytest.raises(ConfigError, match=f"ROS_DOMAIN_ID is '{given}'"):
        choose_domain_id()
