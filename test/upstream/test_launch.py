"""The launch files, by the real `ros2 launch`."""

from __future__ import annotations

import re
import subprocess
from contextlib import ExitStack

import pytest

pytest.importorskip("ros2launch", reason="needs ros2: nox -s upstream")

from nodes.peer import Peer
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python

from nics_drl_bridge.config import find_config
from upstream.launched import PACKAGE

pytestmark = [pytest.mark.ros, pytest.mark.process, pytest.mark.slow]

BRIDGE = ("command_gate", "middleware_node", "policy_node")
NODES = {
    "bridge": BRIDGE,
    "description": (),
    "fleet": (
        "simulator_node",
        *(f"robot{k}.{node}" for k in (1, 2) for node in BRIDGE),
    ),
    "simulation": ("simulator_node", *BRIDGE),
    "simulator": ("simulator_node",),
    "vehicle": BRIDGE,
}
SUFFIXES = ("py", "xml")
FILES = [
    f"{name}.launch.{suffix}"
    for name, nodes in NODES.items()
    if nodes
    for suffix in SUFFIXES
]


@pytest.fixture
def told():
    """The values of parameters, `told(launched, node, *names)`."""
    with ExitStack() as opened:

        def ask(launched, node, *names):
            peer = Peer(launched.domain_id)
            opened.callback(peer.close)
            request = GetParameters.Request(names=list(names))
            answer = peer.call(GetParameters, f"{node}/get_parameters", request)
            return [parameter_value_to_python(value) for value in answer.values]

        yield ask


def arguments(file):
    command = ["ros2", "launch", PACKAGE, file, "--show-args"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("file", FILES)
def test_a_launch_file_runs_and_ctrl_c_ends_all_of_it_well(launch, file):
    launched = launch(file)
    launched.runs(*NODES[file.partition(".")[0]])
    launched.ends_well()


@pytest.mark.parametrize("name", NODES)
def test_the_twin_in_xml_has_the_same_arguments(name):
    python, xml = (arguments(f"{name}.launch.{suffix}") for suffix in SUFFIXES)
    assert python == xml
    assert "'model':" in python
    assert "'namespace':" in python


def test_arguments_reach_every_node(launch, told):
    launched = launch(
        "simulation.launch.py",
        namespace="car",
        model="differential",
        world="corridor",
        policy="go_to_goal",
        stamped="false",
        start="1.0, 0.5, 0.25",
        autostart="false",
        log_level="warn",
    )
    names = "model", "world", "enable_stamped_cmd_vel", "episode_start"
    assert told(launched, "/car/simulator_node", *names)[:3] == [
        "differential",
        "corridor",
        False,
    ]
    (start,) = told(launched, "/car/simulator_node", "episode_start")
    assert list(start) == [1.0, 0.5, 0.25]
    names = (
        "model",
        "enable_stamped_cmd_vel",
        "limits",
        "e_stop_required",
        "use_sim_time",
    )
    given = ["differential", False, "differential", False, True]
    assert told(launched, "/car/command_gate", *names) == given
    names = (
        "policy",
        "model",
        "enable_stamped_cmd_vel",
        "autostart",
        "base_frame",
    )
    given = ["go_to_goal", "differential", False, False, "base_link"]
    assert told(launched, "/car/policy_node", *names) == given
    launched.ends_well()


def test_a_fleet_has_a_bridge_in_each_namespace_with_the_frames_of_its_robot(
    launch, told
):
    launched = launch(
        "fleet.launch.py", robots="[ant, bee]", start="-1 0 0 1 0 0", autostart="false"
    )
    assert list(*told(launched, "/simulator_node", "robots")) == ["ant", "bee"]
    for robot in ("ant", "bee"):
        launched.runs(f"{robot}.command_gate")
        assert told(launched, f"/{robot}/policy_node", "base_frame") == [
            f"{robot}/base_link"
        ]
    launched.ends_well()


def test_what_is_not_given_stands_in_the_file_of_parameters(launch, told, tmp_path):
    text = find_config("bridge", "nodes").read_text(encoding="utf-8")
    own = text.replace("policy: dynamic_window", "policy: mppi")
    own = own.replace("e_stop_required: true", "e_stop_required: false")
    file = tmp_path / "car.yaml"
    file.write_text(own, encoding="utf-8")
    launched = launch("vehicle.launch.py", params_file=file, autostart="false")
    assert told(launched, "/policy_node", "policy") == ["mppi"]
    # But a vehicle requires an emergency stop, whatever its file says.
    names = "e_stop_required", "limits", "use_sim_time"
    assert told(launched, "/command_gate", *names) == [True, "differential", False]
    launched.ends_well()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"start": "1.0"}, "launch argument 'start' is '1.0'; give x, y, heading"),
        ({"model": "ackerman"}, "did you mean 'ackermann'"),
        (
            {"simulator": "gazebo"},
            "Valid options are: \\['simulator', 'mujoco', 'dart'\\]",
        ),
        ({"params_file": "none.yaml"}, "none.yaml: no such file"),
    ],
)
def test_an_argument_that_can_not_be_used_ends_it_with_a_sentence(
    launch, words, sentence
):
    launched = launch("simulation.launch.xml", **words)
    assert launched.wait() == 1
    assert re.search(sentence, launched.text), launched.text
    assert "Traceback" not in launched.text
