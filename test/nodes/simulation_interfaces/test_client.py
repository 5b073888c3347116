import math

import gymnasium
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
pytest.importorskip(
    "simulation_interfaces", reason="needs what `nox -s messages` builds"
)

from builtin_interfaces.msg import Time
from simulation_interfaces import msg

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import device_parameters
from nics_drl_bridge.nodes.conversions import heading_of, heading_to_ros
from nics_drl_bridge.nodes.simulation_interfaces import server
from nics_drl_bridge.nodes.simulation_interfaces.entities import EntityServices
from nics_drl_bridge.nodes.simulator_node import DeviceNode

pytestmark = pytest.mark.ros
STEPS = 8
TIMEOUT_S = 60.0


@pytest.fixture
def make(model):
    """Makes envs over the standard alone; all are closed with the test."""
    register_envs()
    made = []

    def env_of(domain_id, world="circles", **options):
        given = {"domain_id": domain_id, "timeout_s": TIMEOUT_S, **options}
        made.append(
            gymnasium.make(
                NAVIGATION,
                backend="ros",
                simulator="simulation_interfaces",
                model=model,
                world=world,
                backend_options=given,
            )
        )
        return made[-1]

    yield env_of
    for each in made:
        each.close()


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_an_env_places_and_steps_a_simulator_by_the_standard_alone(
    launch, domain_id, make, client_of, mode
):
    launch("simulator_node", domain_id, world="circles", mode=mode, scan_rate=10.0)
    env = make(
        domain_id, truth=True, standard={} if mode == "lockstep" else {"slack_s": 0.05}
    )
    ours = gymnasium.make(
        NAVIGATION, model=env.unwrapped.model, world="circles", estimator=True
    )
    action = np.array([0.6, 0.3], np.float32)
    for seed in (3, 4):
        first, info = env.reset(seed=seed)
        assert info["pose"] == pytest.approx(info["start"], abs=1e-6)
        expected, _ = ours.reset(seed=seed)
        # The obstacles stand where the seed has them; beams at their edges go either way.
        assert np.mean(np.abs(first - expected) < 0.05) > 0.9
        for _ in range(STEPS):
            _, _, _, _, info = env.step(action)
            _, _, _, _, known = ours.step(action)
        # A robot that begins a period later, with noise of its own.
        assert info["pose"] == pytest.approx(known["pose"], abs=0.05)
        assert info["true_pose"] == pytest.approx(known["true_pose"], abs=0.05)
    assert int(client_of(domain_id)("GetSimulationState").state.state) == 2


@pytest.mark.parametrize("stamped", [True, False])
def test_a_simulator_that_puts_time_back_and_tells_of_it_by_steps_alone_is_driven(
    launch, domain_id, make, monkeypatch, stamped
):
    fewer = tuple(name for name in server.FEATURES if name != "SIMULATION_RESET_STATE")
    monkeypatch.setattr(server, "FEATURES", fewer)
    begin = DeviceNode.begin
    state = EntityServices.state

    def silent(self, rewind=False):
        with monkeypatch.context() as patch:
            patch.setattr(self, "_publish", lambda: None)
            begin(self, rewind)

    def told_of(self, entity):
        told = state(self, entity)
        told.header.stamp = told.header.stamp if stamped else Time()
        return told

    monkeypatch.setattr(DeviceNode, "begin", silent)
    monkeypatch.setattr(EntityServices, "state", told_of)
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    env = make(domain_id)
    stamps = set()
    for seed in (3, 4):
        _, info = env.reset(seed=seed)
        start = info["start"]
        assert info["pose"] == pytest.approx(start, abs=1e-6)
        for _ in range(STEPS):
            _, _, _, _, info = env.step(np.array([0.6, 0.0], np.float32))
        assert math.dist(info["pose"][:2], start[:2]) > 0.1
        stamps.add(info["stamp_ns"])
    assert len(stamps) == 1  # of a time that was put back


def test_steps_of_a_rounded_length_are_followed(launch, domain_id, make, monkeypatch):
    timing = device_parameters.timing
    rounded = {"step_ns": 100_000_002, "odom_ns": 100_000_002, "scan_ns": 100_000_002}
    monkeypatch.setattr(
        device_parameters,
        "timing",
        lambda node, model: timing(node, model)._replace(**rounded),
    )
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    env = make(domain_id)
    env.reset(seed=3)
    stamps = [
        env.step(np.array([0.6, 0.0], np.float32))[4]["stamp_ns"] for _ in range(STEPS)
    ]
    assert set(np.diff(stamps)) == {100_000_002}


def test_what_stands_above_the_floor_or_tilted_stays_so(
    launch, domain_id, make, monkeypatch
):
    state = EntityServices.state
    put = EntityServices.set_state
    placed = {}

    def raised(self, entity):
        told = state(self, entity)
        told.pose.position.z, told.pose.orientation.x = 0.17, 0.1
        return told

    def flat(self, request, response):
        pose = request.state.pose
        placed[request.entity] = (pose.position.z, pose.orientation.x != 0.0)
        pose.position.z = 0.0
        turn = pose.orientation
        pose.orientation = heading_to_ros(heading_of(turn.x, turn.y, turn.z, turn.w))
        put(self, request, response)

    monkeypatch.setattr(EntityServices, "state", raised)
    monkeypatch.setattr(EntityServices, "set_state", flat)
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    env = make(domain_id)
    _, info = env.reset(seed=3)
    assert info["pose"] == pytest.approx(info["start"], abs=1e-6)
    assert {"obstacle_0", env.unwrapped.model.robot.name} <= placed.keys()
    assert set(placed.values()) == {(0.17, True)}


def test_a_feature_that_is_missing_is_named_when_the_env_is_made(
    launch, domain_id, make, monkeypatch
):
    fewer = tuple(name for name in server.FEATURES if name != "ENTITY_STATE_SETTING")
    monkeypatch.setattr(server, "FEATURES", fewer)
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    with pytest.raises(
        BackendError, match="does not have the feature ENTITY_STATE_SETTING"
    ):
        make(domain_id)


def test_steps_that_are_refused_are_told(launch, domain_id, make, client_of):
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    env = make(domain_id)
    env.reset(seed=0)
    client_of(domain_id).set_state(msg.SimulationState.STATE_PLAYING)

    def drive():
        for _ in range(STEPS):
            env.step(np.zeros(2, np.float32))

    with pytest.raises(BackendError, match=r"refused StepSimulation: .* not paused"):
        drive()


def test_the_robot_has_another_name_in_another_simulator(launch, domain_id, make):
    launch("simulator_node", domain_id, world="circles", mode="lockstep")
    env = make(domain_id, standard={"entity": "waffle"})
    with pytest.raises(
        BackendError, match="refused GetEntityState: there is no entity 'waffle'"
    ):
        env.reset(seed=0)


@pytest.mark.parametrize("options", [{"mode": "realtime"}, {"randomisation": "mild"}])
def test_what_the_standard_can_not_do_is_refused(make, domain_id, options):
    with pytest.raises(ConfigError, match="in mode 'lockstep', without randomisation"):
        make(domain_id, **options)
