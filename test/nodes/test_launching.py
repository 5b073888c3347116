"""Launch descriptions start what `nics up` starts; `nox -s upstream` has `launch`."""

import pytest

pytest.importorskip("launch_ros", reason="needs launch: nox -s upstream")

from launch.actions import DeclareLaunchArgument, OpaqueFunction

from launch import LaunchContext
from nics_drl_bridge.nodes import launching
from nics_drl_bridge.nodes.launching import describe
from nics_drl_bridge.nodes.starting import LAUNCHES

pytestmark = pytest.mark.ros

GIVEN = [
    {},
    {
        "model": "mecanum",
        "namespace": "hall",
        "use_robot_state_pub": "true",
        "rviz": "1",
    },
]


def plain(value):
    """A parameter as the node will have it."""
    if not isinstance(value, launching.ParameterValue):
        return value
    return value.evaluate(LaunchContext())


def launched(launch, given, monkeypatch):
    """What `launch` is told to start for some arguments."""
    monkeypatch.setattr(launching, "Node", dict)
    context = LaunchContext()
    context.launch_configurations.update(given)
    nodes = []
    for action in describe(launch).entities:
        if isinstance(action, DeclareLaunchArgument):
            action.execute(context)
        elif isinstance(action, OpaqueFunction):
            nodes += action.execute(context)
    return nodes


@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("name", LAUNCHES)
def test_a_launch_file_starts_the_same_nodes_with_the_same_parameters(
    name, given, monkeypatch
):
    launch = LAUNCHES[name]
    known = {argument.name for argument in launch.arguments}
    given = {key: value for key, value in given.items() if key in known}
    wanted = launch.nodes(given)
    found = launched(launch, given, monkeypatch)
    assert [node["executable"] for node in found] == [
        node.executable for node in wanted
    ]
    assert [node["namespace"] for node in found] == [
        f"/{node.namespace}" for node in wanted
    ]
    for one, other in zip(found, wanted, strict=True):
        *files, parameters = one["parameters"]
        paths = [file.param_file[0].text for file in files]
        assert paths == ([other.params_file] if other.params_file else [])
        assert {
            key: plain(value) for key, value in parameters.items()
        } == other.parameters
        assert one["remappings"] == list(other.remappings)


def test_a_text_that_looks_like_a_number_stays_a_text(monkeypatch):
    monkeypatch.setattr("nics_drl_bridge.sim.world_set.load_worlds", lambda name: None)
    (node,) = launched(LAUNCHES["simulator"], {"world": "7"}, monkeypatch)
    assert plain(node["parameters"][-1]["world"]) == "7"


def test_a_fleet_below_a_pushed_namespace_has_its_transforms_there(monkeypatch):
    given = {"ros_namespace": "/site", "namespace": "hall", "robots": "[ant, bee]"}
    nodes = launched(LAUNCHES["fleet"], given, monkeypatch)
    assert {node["namespace"] for node in nodes} >= {"/site/hall", "/site/hall/bee"}
    places = {dict(node["remappings"])["/tf"] for node in nodes}
    assert places == {"tf", "/site/hall/tf"}
