import math

import pytest

pytest.importorskip(
    "simulation_interfaces", reason="needs what `nox -s messages` builds"
)

from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan
from simulation_interfaces import msg, srv
from std_srvs.srv import Trigger

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.simulator_node import DeviceNode
from nics_drl_bridge.sim.device import DeviceWorld

pytestmark = pytest.mark.ros
STATES = msg.SimulationState
OK = msg.Result.RESULT_OK


MESH = (
    "<sdf version='1.9'><model name='m'><link name='l'><collision name='c'><geometry><mesh>"
    "<uri>a.dae</uri></mesh></geometry></collision></link></model></sdf>"
)
FIELD = "name: {}\nsize: [{}, 4.0]\ngoal_distance: [1.0, 3.0]\n"


def spawned(**fields):
    return {"name": "one", "entity_resource": msg.Resource(**fields)}


@pytest.fixture(scope="module")
def simulator(launch, module_domain_id):
    process = launch(
        "simulator_node", module_domain_id, world="empty", robots=["left", "right"]
    )
    yield module_domain_id
    process.check()


@pytest.fixture(scope="module")
def connected(simulator, client_of):
    """One for all tests: a process has no room for as many participants of DDS."""
    return client_of(simulator)


@pytest.fixture
def client(connected):
    connected("LoadWorld", world_resource=msg.Resource(uri="empty"))
    connected.start()
    return connected


def test_every_feature_does_what_the_standard_says_and_every_other_is_refused(client):
    from parts.conformance import announced, failures

    assert len(announced(client)) == 16
    assert failures(client, "empty") == []


@pytest.mark.slow
def test_robots_in_mujoco_serve_the_same(launch, domain_id, client_of):
    pytest.importorskip("mujoco", reason="needs MuJoCo: the extra `mujoco`")
    from parts.conformance import CHECKS

    launch("mujoco_node", domain_id, world="empty")
    client = client_of(domain_id)
    for feature in ("SPAWNING", "SIMULATION_RESET", "STEP_SIMULATION_MULTIPLE"):
        client.start()
        assert CHECKS[feature](client), feature


def test_a_spawned_robot_has_topics_until_it_is_deleted(client, meet, simulator):
    spawned = client.spawn(
        "third",
        1.0,
        entity_resource=msg.Resource(uri="ackermann"),
        entity_namespace="third",
    )
    assert spawned.result.result == OK, spawned.result.error_message
    peer = meet(simulator)
    scans, odoms = (
        peer.listen(LaserScan, "third/scan"),
        peer.listen(Odometry, "third/odom"),
    )
    commands = peer.speak(Twist, "third/cmd_vel")
    command = Twist()
    command.linear.x = 0.5
    commands.publish(command)
    client.set_state(STATES.STATE_PLAYING)
    peer.until(
        lambda: scans and odoms and odoms[-1].twist.twist.linear.x > 0.1, "it drives"
    )
    assert client.code("DeleteEntity", entity="third") == OK
    peer.until(lambda: peer.node.count_publishers("/third/scan") == 0, "its topics end")
    assert client.names() == ["left", "right"]


@pytest.mark.parametrize(
    ("name", "space", "code", "sentence"),
    [
        ("3rd", "", msg.SpawnResult.NAME_INVALID, "the name '3rd' makes no namespace"),
        ("x" * 121, "", msg.SpawnResult.NAME_INVALID, "use up to 120 letters"),
        (
            "third",
            "y" * 300,
            msg.SpawnResult.NAMESPACE_INVALID,
            "is no namespace of ROS",
        ),
        (
            "third",
            "left",
            msg.SpawnResult.NAMESPACE_INVALID,
            "is that of another robot",
        ),
        (
            "third",
            "/right",
            msg.SpawnResult.NAMESPACE_INVALID,
            "is that of another robot",
        ),
    ],
)
def test_a_robot_whose_topics_can_not_be_named_is_refused(
    client, name, space, code, sentence
):
    robot = msg.Resource(uri="ackermann")
    answer = client.spawn(name, 1.0, entity_resource=robot, entity_namespace=space)
    assert (answer.result.result, sentence in answer.result.error_message) == (
        code,
        True,
    ), answer
    assert client.names() == ["left", "right"]
    client.set_state(STATES.STATE_PLAYING)
    assert client.code("GetEntityState", entity="left") == OK  # it lives


def test_a_robot_that_can_not_have_its_topics_is_not_there(client, monkeypatch):
    def broken(*_):
        raise RuntimeError("no topics")

    monkeypatch.setattr(DeviceNode, "add_robot", broken)
    refused = client.spawn(
        "third", 1.0, entity_resource=msg.Resource(uri="ackermann")
    ).result
    assert "no topics" in refused.error_message
    assert client.names() == ["left", "right"]


def test_the_last_robot_is_not_removed_as_spawned_and_nothing_else_is(client):
    client.spawn("disc", 2.0)
    assert (
        client.spawn(
            "r2", 1.0, entity_resource=msg.Resource(uri="ackermann")
        ).result.result
        == OK
    )
    for own in ("left", "right"):
        assert client.code("DeleteEntity", entity=own) == OK
    refused = client(
        "ResetSimulation", scope=srv.ResetSimulation.Request.SCOPE_SPAWNED
    ).result
    assert refused.result == msg.Result.RESULT_OPERATION_FAILED
    assert "a simulator needs a robot, and all were spawned" in refused.error_message
    assert client.names() == ["r2", "disc"] or client.names() == ["disc", "r2"]
    assert client.code("ResetSimulation") == OK
    assert client.names() == ["left", "right"]


def test_obstacles_of_the_first_episode_are_entities(launch, domain_id, client_of):
    launch("simulator_node", domain_id, world="circles")
    client = client_of(domain_id)
    client.set_state(STATES.STATE_PAUSED)
    names = client.names()
    assert len([name for name in names if name.startswith("obstacle_")]) == 10
    assert client.code("DeleteEntity", entity="obstacle_0") == OK
    assert set(names) - set(client.names()) == {"obstacle_0"}


def test_after_one_robot_is_deleted_the_others_keep_their_topics_and_starts(
    launch, domain_id, client_of, meet
):
    start = [-1.0, 0.0, 0.0, 1.0, -1.0, 0.5]
    node = launch(
        "simulator_node",
        domain_id,
        world="empty",
        robots=["left", "right"],
        episode_start=start,
    )
    client = client_of(domain_id)
    peer = meet(domain_id)
    truths = peer.listen(Odometry, "right/ground_truth")
    assert client.code("DeleteEntity", entity="left") == OK
    assert peer.call(Trigger, "simulator_node/reset").success

    def stands(x, y):
        return (
            truths
            and math.dist(conversions.odometry_from_ros(truths[-1])[0][:2], (x, y))
            < 0.01
        )

    peer.until(lambda: stands(1.0, -1.0), "the robot at its own start")
    pose = PoseWithCovarianceStamped()
    pose.header.frame_id, pose.pose.pose.position.x = "map", 0.5
    pose.pose.pose.orientation.w = 1.0
    peer.speak(PoseWithCovarianceStamped, "right/initialpose").publish(pose)
    peer.until(lambda: stands(0.5, 0.0), "the robot there")
    assert peer.node.count_subscribers("/left/initialpose") == 0
    node.check()


def test_poses_may_be_given_in_the_frame_of_an_entity(client):
    base = msg.EntityState()
    base.pose.position.x, base.pose.orientation.z, base.pose.orientation.w = (
        1.0,
        1.0,
        0.0,
    )
    assert client.code("SetEntityState", entity="left", state=base, set_pose=True) == OK
    beside = msg.EntityState()
    beside.header.frame_id, beside.pose.position.x = "left", 0.5
    assert (
        client.code("SetEntityState", entity="right", state=beside, set_pose=True) == OK
    )
    found = client("GetEntityState", entity="right").state
    assert found.pose.position.x == pytest.approx(0.5, abs=1e-6)
    beside.header.frame_id = "nowhere"
    wrong = client("SetEntityState", entity="right", state=beside, set_pose=True).result
    assert wrong.result == srv.SetEntityState.Response.INVALID_POSE
    assert "'nowhere' is not known" in wrong.error_message


@pytest.mark.parametrize(
    ("name", "fields", "code", "sentence"),
    [
        ("GetEntityState", {"entity": "x"}, 2, "there is no entity 'x'"),
        (
            "GetEntities",
            {"filters": msg.EntityFilters(filter="(")},
            4,
            "no regular expression",
        ),
        (
            "GetEntities",
            {"filters": msg.EntityFilters(tags=msg.TagsFilter(tags=["a"]))},
            0,
            "leave out all else",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(resource_string="name: x")},
            0,
            "give a uri",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="hall.sdf")},
            101,
            "convert it",
        ),
        ("StepSimulation", {"steps": 0}, 4, "steps is 0"),
        ("StepSimulation", {"steps": 2**63}, 4, "ask for 1 to"),
        ("ResetSimulation", {"scope": 8}, 0, "scope 8"),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="nowhere")},
            2,
            "unknown world",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="/no/a.yaml")},
            2,
            "no such file",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="/no/[ab].yaml")},
            103,
            "no world file",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="x" * 300)},
            2,
            "name too long",
        ),
        ("SpawnEntity", spawned(uri="x" * 300), 2, "name too long"),
        (
            "SpawnEntity",
            spawned(resource_string="<sdf version='1.9'><model name='m'></sdf>"),
            106,
            "is not valid XML",
        ),
        (
            "SpawnEntity",
            spawned(resource_string=MESH),
            108,
            "has a mesh",
        ),
        (
            "LoadWorld",
            {"world_resource": msg.Resource(uri="http://a/b.sdf")},
            101,
            "this machine",
        ),
        (
            "SetSimulationState",
            {"state": STATES(state=77)},
            103,
            "state 77 can't be set",
        ),
    ],
)
def test_a_wrong_argument_is_answered_by_a_code_and_one_sentence(
    client, name, fields, code, sentence
):
    result = client(name, **fields).result
    assert (result.result, sentence in result.error_message) == (code, True), result
    assert "\n" not in result.error_message
    assert client("GetCurrentWorld").world.name == "empty"  # it stays


def test_a_simulator_that_was_asked_to_quit_answers_and_ends(
    launch, domain_id, client_of
):
    process = launch("simulator_node", domain_id, world="empty")
    assert client_of(domain_id).set_state(STATES.STATE_QUITTING) == OK
    assert process.wait() == 0


def test_the_services_can_be_turned_off(launch, domain_id, meet):
    launch("simulator_node", domain_id, world="empty", simulation_interfaces=False)
    peer = meet(domain_id)
    peer.be_known_to("simulator_node")
    found = {name for name, _ in peer.node.get_service_names_and_types()}
    assert "/simulator_node/reset" in found
    assert "/get_simulator_features" not in found


def test_the_map_is_that_of_the_world_that_is_loaded_also_where_nothing_stands(
    client, meet, simulator, tmp_path
):
    peer = meet(simulator)
    maps = peer.listen(OccupancyGrid, "map", qos.LATCHED)
    for side in (5.0, 7.0):
        file = tmp_path / f"{side:g}.yaml"
        file.write_text(FIELD.format("text", side), encoding="utf-8")
        world = msg.Resource(uri=f"file://{file}")
        assert client.code("LoadWorld", world_resource=world) == OK
        peer.until(
            lambda side=side: (
                maps and maps[-1].info.width * maps[-1].info.resolution // 1 == side
            ),
            "the map of the world",
        )


def test_a_reset_that_fails_leaves_the_time_where_it_is(client, monkeypatch):
    assert client.code("StepSimulation", steps=5) == OK

    def fails(*_):
        raise ConfigError("no room.")

    before = client.time_ns()
    with monkeypatch.context() as patch:
        patch.setattr(DeviceWorld, "begin", fails)
        failed = client("ResetSimulation", scope=0).result
    assert (failed.result, failed.error_message) == (4, "no room.")
    assert client.time_ns() == before


def test_a_launched_robot_comes_back_where_another_took_its_name(
    client, meet, simulator
):
    assert client.code("DeleteEntity", entity="left") == OK
    robot = {
        "entity_resource": msg.Resource(uri="ackermann"),
        "entity_namespace": "other",
    }
    assert client.spawn("left", 1.0, **robot).result.result == OK
    assert client.code("DeleteEntity", entity="right") == OK
    robot["entity_namespace"] = "third"
    assert client.spawn("right", -1.0, **robot).result.result == OK
    assert client.code("ResetSimulation", scope=0) == OK
    peer = meet(simulator)
    peer.until(
        lambda: (
            peer.node.count_publishers("/left/scan") == 1
            and peer.node.count_publishers("/other/scan") == 0
        ),
        "its topics",
    )


@pytest.mark.parametrize("world", ["{}/*.yaml", "barn/7"])
def test_the_world_that_a_node_began_with_can_be_loaded_again(
    launch, domain_id, client_of, tmp_path, world
):
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(
            FIELD.format(name, 5.0), encoding="utf-8"
        )
    launch("simulator_node", domain_id, world=world.format(tmp_path))
    client = client_of(domain_id)
    told = client("GetCurrentWorld").world
    loaded = client("LoadWorld", world_resource=told.world_resource)
    assert loaded.result.result == OK, loaded.result.error_message
    assert loaded.world == told
