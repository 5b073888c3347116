"""`nics up`, `nics arm`, `nics goal` and `nics stop`, as on a machine with the wheels alone."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from unittest import mock

import pytest
import typer
from command_line import nics
from domains import claimed_domain

from nics_drl_bridge.commands import up
from nics_drl_bridge.nodes import processes, starting
from nics_drl_bridge.nodes.starting import LAUNCHES, NodeStart

NICS = [sys.executable, "-m", "nics_drl_bridge.commands.start"]
COMPILED_S = 250.0  # for which the kernels may take
ENDED_S = 30.0
ARRIVE_S = 10.0
ATTEMPTS = 6
NODES = ("simulator_node", "command_gate", "middleware_node", "policy_node")

ASK_MODULES = """
import sys
from nics_drl_bridge.commands import start
for words in ("arm", "stop", "goal 1 0"):
    sys.argv = ["nics", *words.split(), "--wait", "0"]
    try:
        start.main()
    except SystemExit as end:
        print(end.code, set(sys.modules) & {"numba", "scipy", "rclpy"})
"""


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("up simulaton", "did you mean 'simulation'?"),
        ("up simulation wrld:=arena", "unknown argument 'wrld'; did you mean 'world'?"),
        ("up simulation world=arena", "'world=arena': write name:=value"),
        ("up simulation --world arena", "'--world': write name:=value"),
        ("up simulation world:=a world:=b", "'world' is given twice"),
        ("up simulation stamped:=maybe", "'stamped' is 'maybe'; give true or false"),
        ("up vehicle e_stop_required:=false", "unknown argument 'e_stop_required'"),
        ("up vehicle params_file:=none.yaml", "none.yaml: no such file"),
        ("up vehicle rviz:=true", "the ROS 2 package 'rviz2' is not installed here"),
        ("arm --namespace 2nd", "namespace '2nd'"),
        ("stop --namespace 2nd", "namespace '2nd'"),
    ],
)
def test_a_wrong_argument_is_one_sentence_and_starts_nothing(
    words, sentence, tmp_path, monkeypatch
):
    for module in (starting, processes):
        monkeypatch.setattr(module, "find_prefix", lambda package: None)
    done = nics(*words.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert sentence in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("name", LAUNCHES)
def test_every_launch_lists_its_arguments(name, tmp_path):
    told = nics("up", name, "--show-args", cwd=tmp_path).stdout
    assert all(f"{one.name}:=" in told for one in LAUNCHES[name].arguments)


@pytest.mark.parametrize(
    ("executables", "step"),
    [
        (("robot_state_publisher", "rviz2"), ""),
        (("simulator_node",), "next: send commands on cmd_vel"),
        (("simulator_node", "command_gate"), "next, in another terminal: `nics arm`"),
    ],
)
def test_the_next_step_is_one_that_these_nodes_can_take(executables, step):
    nodes = [
        NodeStart("nics_drl_bridge", executable, "", {}) for executable in executables
    ]
    told = up.describe_next_step(nodes)
    assert told.startswith(step)
    assert bool(told) == bool(step)


@pytest.mark.ros
@pytest.mark.process
def test_a_command_to_a_running_robot_loads_no_simulator():
    """An emergency stop must not wait for seconds of imports."""
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    with claimed_domain() as domain_id:
        done = subprocess.run(
            [sys.executable, "-c", ASK_MODULES],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain_id)},
            capture_output=True,
            text=True,
        )
    assert done.stdout == "2 {'rclpy'}\n" * 3, done.stderr


class Up:
    """`nics up` in a process of its own, and the commands that talk to its nodes."""

    def __init__(self, folder: Path, domain_id: int, *words: str) -> None:
        self.folder = folder
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(domain_id)}
        self.text = ""
        self.process = subprocess.Popen(
            [*NICS, "up", *words],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            cwd=folder,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    @property
    def children(self) -> list[int]:
        pid = self.process.pid
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text()
        return [int(child) for child in children.split()]

    def runs(self, *nodes: str) -> None:
        while not all(f"[{node}]: running" in self.text for node in nodes):
            line = self.process.stdout.readline()
            assert line, self.text
            self.text += line

    def tell(self, words: str) -> subprocess.CompletedProcess[str]:
        with mock.patch.dict(os.environ, self.environment):
            return nics(words, cwd=self.folder)

    def ends(self, within_s: float) -> int:
        self.text += self.process.communicate(timeout=within_s)[0]
        return self.process.returncode

    def end(self, number: int) -> int:
        self.process.send_signal(number)
        return self.ends(ENDED_S)

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def start(tmp_path):
    """Starts `nics up`, `start(*words)`; it ends with the test."""
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    started = []
    with claimed_domain() as domain_id:

        def make(*words):
            started.append(Up(tmp_path, domain_id, *words))
            return started[-1], domain_id

        yield make
        for each in started:
            each.kill()


def gone(children):
    """Whether processes have ended, or do so soon."""
    for child in children:
        with suppress(ProcessLookupError):
            process = os.pidfd_open(child)
            ended, _, _ = select.select([process], [], [], ENDED_S)
            os.close(process)
            if not ended:
                return False
    return True


def drives(up, witness, goal):
    """Whether the robot gets to a goal; its gate may stop it where the machine is busy."""
    for _ in range(ATTEMPTS):
        if witness.arrives(goal, 0.4, ARRIVE_S):
            return True
        up.tell("arm --reset")
    return False


linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@linux
@pytest.mark.ros
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_simulation_is_armed_driven_stopped_and_ended_by_nics_alone(start):
    from nics_drl_bridge.nodes.operator import Witness

    up, domain_id = start("simulation", "world:=empty", "start:=[0.0, 0.0, 0.0]")
    up.runs(*NODES)
    assert "nics arm" in up.text
    with Witness(domain_id) as witness:
        assert witness.sees(ENDED_S)
        armed = up.tell("arm")
        assert armed.returncode == 0, armed.stderr
        assert "/command_gate is armed" in armed.stdout
        goal = up.tell("goal 0.8 -0.3 --wait 90")
        assert goal.returncode == 0, goal.stderr
        assert "drives to (0.80, -0.30) m in the map" in goal.stdout
        assert drives(up, witness, (0.8, -0.3)), up.text
        stopped = up.tell("stop")
        assert stopped.returncode == 0, stopped.stderr
        assert "/command_gate has stopped its robot" in stopped.stdout
        refused = up.tell("arm --wait 6")
        assert refused.returncode == 1
        assert "refuses to arm" in refused.stderr
        assert "e_stop_released: e_stop_pressed" in refused.stderr
        again = up.tell("arm --reset")
        assert again.returncode == 0, again.stderr
        nowhere = up.tell("goal 1 0 --frame kitchen --wait 8")
        assert nowhere.returncode == 1
        assert "a goal in the frame 'kitchen' is refused" in nowhere.stderr
    children = up.children
    assert len(children) == len(NODES)
    assert up.end(signal.SIGINT) == 130, up.text
    assert gone(children)
    assert "Traceback" not in up.text


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_would_end_it_at_once_ends_its_nodes_first(number):
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with pytest.raises(SystemExit) as end, up.end_nodes_by_signals():
            signal.raise_signal(number)
        assert end.value.code == 128 + number
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


@linux
@pytest.mark.campaign
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGHUP])
def test_no_node_outlives_it_whatever_signal_ends_it(start, number):
    up, _ = start("simulator", "world:=empty")
    up.runs("simulator_node")
    children = up.children
    assert len(children) == 1
    assert up.end(number) in (128 + number, -number)
    assert gone(children)


STAND_IN = """
import os, pathlib, sys, time
if sys.argv[1] == "policy_node":
    while len(os.listdir("others")) < 2:
        time.sleep(0.01)
    print("unknown policy", file=sys.stderr)
    sys.exit(2)
pathlib.Path("others", str(os.getpid())).touch()
time.sleep(600)
"""


@linux
@pytest.mark.process
def test_a_node_that_can_not_start_ends_the_others_with_its_sentence(
    tmp_path, monkeypatch, capfd
):
    others = tmp_path / "others"
    others.mkdir()
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-c", STAND_IN]
    monkeypatch.setattr(processes, "make_module_command", lambda _: command)
    nodes = LAUNCHES["vehicle"].nodes({"use_robot_state_pub": "false"})
    with pytest.raises(typer.Exit) as end:
        up.run(nodes)
    assert end.value.exit_code == 2
    told = capfd.readouterr().err
    assert "unknown policy" in told
    assert "policy_node ended with code 2, so all nodes were ended" in told
    children = [int(file.name) for file in others.iterdir()]
    assert len(children) == 2
    assert gone(children)


@pytest.mark.ros
@pytest.mark.process
@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("arm",), "command_gate"),
        (("stop",), "command_gate"),
        (("goal", 1, 0), "policy_node"),
    ],
)
def test_where_nothing_runs_each_command_says_so(
    words, what, start, tmp_path, monkeypatch
):
    with claimed_domain() as domain_id:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
        done = nics(*words, "--wait 0.5", cwd=tmp_path)
    assert done.returncode == 2
    assert f"no {what} was seen in namespace / of ROS domain {domain_id}" in done.stderr


def test_a_node_gets_text_as_text_above_the_values_of_the_users_file(tmp_path):
    parameters = {
        "world": "7",
        "policy": "1e3",
        "robots": ["1", "true"],
        "rate": 2.0,
        "on": True,
    }
    node = NodeStart("nics_drl_bridge", "policy_node", "ant", parameters, "own.yaml")
    words = processes.make_command(node, tmp_path)
    assert words[words.index("-r") + 1] == "__ns:=/ant"
    files = [words[k + 1] for k, word in enumerate(words) if word == "--params-file"]
    assert files[0] == "own.yaml"
    text = Path(files[1]).read_text(encoding="utf-8")
    for line in (
        '"/ant/policy_node":',
        '"world": "7"',
        '"policy": "1e3"',
        '- "true"',
        '"rate": 2.0',
        '"on": true',
    ):
        assert line in text
