import gc
import signal
from contextlib import closing

import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist
from rclpy.task import Future

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import BackendError, ConfigError, ModelError, StaleDataError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import Start
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.backends import (
    DdsBackend,
    dds_backend,
    stack_facts,
)
from nics_drl_bridge.sim.scenes import member_of
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros

TIMEOUT_S = 30.0
SHORT_S = 2.0
NAMESPACE = "fleet/car_1"
START = Start(seed=3, pose=np.array([0.5, -0.5, 1.0]))


@pytest.fixture(scope="module")
def arena():
    return load_world("arena")


@pytest.fixture(scope="module")
def simulator(launch, module_domain_id):
    """The domain of a simulator in lock-step, and its process."""
    process = launch("simulator_node", module_domain_id, mode="lockstep")
    yield module_domain_id, process
    process.check()


@pytest.fixture
def connect(simulator, model, arena):
    """Makes backends on that simulator; all are closed with the test."""
    made = []

    def make(**options):
        options = {"domain_id": simulator[0], "timeout_s": TIMEOUT_S} | options
        made.append(
            DdsBackend(
                options.pop("model", model), options.pop("world", arena), **options
            )
        )
        return made[-1]

    yield make
    for backend in made:
        backend.close()


@pytest.fixture
def own_simulator(launch_process, domain_id, model, arena):
    """A backend on a simulator that the test may harm, in a namespace."""
    process = launch_process(
        "simulator_node", domain_id, namespace=NAMESPACE, mode="lockstep"
    )
    backend = DdsBackend(
        model, arena, namespace=NAMESPACE, domain_id=domain_id, timeout_s=TIMEOUT_S
    )
    yield backend, process, domain_id
    backend.close()
    process.close()


@pytest.fixture(scope="module")
def commands_heard(simulator, meet):
    """Speed of each command that reaches somebody else than the simulator."""
    peer = meet(simulator[0])
    return peer, peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)


def episodes(env, seeds, steps, rng):
    """All that an env tells, under random commands, over several episodes."""
    told = []
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        told.append(
            (observation, 0.0, False, info["pose"], np.zeros((3, 3)), info["start"])
        )
        for _ in range(steps):
            observation, reward, ended, _, info = env.step(
                rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
            )
            known = info["pose"], info["covariance"], info["true_pose"]
            told.append((observation, reward, ended, *known))
    return [np.array(column, dtype=np.float64) for column in zip(*told, strict=True)]


def drive(backend, speed=0.5, steps=3):
    backend.reset(START)
    for _ in range(steps):
        backend.step(np.array([speed, 0.0]))


def zero_follows(commands_heard, step, act):
    """Waits until the last command that is heard after an act is zero."""
    peer, heard = commands_heard
    heard.clear()
    peer.until(
        lambda: step() and heard, "a command: the listener has found the backend"
    )
    act()
    peer.until(lambda: heard and heard[-1] == Twist(), "a zero command")


def complaint(backend):
    """What a backend says about others on its topic; the name of a node may come late."""
    try:
        backend._link.check_alone()
    except BackendError as error:
        return str(error)
    return ""


def compare(here, there, seeds, steps):
    """Drives two envs alike: all that they tell must be the same to the bit."""
    with closing(there):
        told = [
            episodes(env, seeds, steps, np.random.default_rng(0))
            for env in (here, there)
        ]
    *seen, truth = (np.abs(a - b).max() for a, b in zip(*told, strict=True))
    # observation, reward, end, estimate and covariance; a quaternion rounds the true heading
    assert seen == [0.0] * 5
    assert truth < 1e-12


def test_it_gives_the_numbers_of_the_simulator_in_process(simulator, model, arena):
    options = {"domain_id": simulator[0], "truth": True, "timeout_s": TIMEOUT_S}
    here = BridgeEnv("sim", model, arena, estimator=True)
    there = BridgeEnv("dds", model, arena, backend_options=options)
    compare(here, there, (7, 7, 2**31 - 1), 20)


def test_episodes_in_a_set_of_worlds_with_maps_and_moving_obstacles_are_the_same(
    launch, domain_id, model, tmp_path
):
    world = tmp_path / "mixed.yaml"
    world.write_text("name: mixed\nworlds: [crowd, room, corridor]\n")
    launch("simulator_node", domain_id, mode="lockstep", world=str(world))
    options = {"domain_id": domain_id, "truth": True, "timeout_s": TIMEOUT_S}
    here = BridgeEnv("sim", model, str(world), estimator=True)
    there = BridgeEnv("dds", model, str(world), backend_options=options)
    assert {member_of(here.world, seed) for seed in range(4)} == {0, 1, 2}
    compare(here, there, range(4), 8)
    assert np.array_equal(here.scene.bodies, there.scene.bodies)


def test_a_team_over_dds_sees_what_a_team_in_process_sees(launch, model, domain_id):
    launch("simulator_node", domain_id, mode="lockstep", robots=["a", "b"])
    options = {"domain_id": domain_id, "namespaces": ["a", "b"]}
    team = {"task": "cooperative_reaching", "task_options": {"robots": 2}}
    here = BridgeEnv(model=model, estimator=True, **team)
    there = BridgeEnv(model=model, backend="dds", backend_options=options, **team)
    with closing(there):
        drive_alike(here, there)


def test_a_randomised_episode_over_dds_is_the_one_in_process(launch, model, domain_id):
    launch("simulator_node", domain_id, mode="lockstep", randomisation="strong")
    options = {"backend_options": {"domain_id": domain_id}}
    here = BridgeEnv(model=model, randomisation="strong", estimator=True)
    with closing(BridgeEnv("dds", model, randomisation="strong", **options)) as there:
        drive_alike(here, there)
    with (
        closing(BridgeEnv("dds", model, randomisation="mild", **options)) as env,
        pytest.raises(ModelError, match="start both with the same randomisation"),
    ):
        env.reset(seed=3)


def drive_alike(here, there):
    for seed in (3, 4):
        assert (here.reset(seed=seed)[0] == there.reset(seed=seed)[0]).all()
        for k in range(5):
            action = np.full(here.action_space.shape, 0.1 * k, np.float32)
            mine = here.step(action)
            theirs = there.step(action)
            assert (mine[0] == theirs[0]).all()
            assert mine[1] == theirs[1]


def test_each_view_is_of_the_step_and_one_control_period_after_the_last(connect, model):
    backend = connect()
    assert backend.reset(START).pose == pytest.approx(START.pose)
    stamps = []
    for _ in range(5):
        view, facts = backend.step(np.array([0.5, 0.0]))
        assert (view.scan_age_s, view.odom_age_s) == (0.0, 0.0)
        assert view.stamp_s == facts["stamp_ns"] * 1e-9
        stamps.append(facts["stamp_ns"])
    assert set(np.diff(stamps)) == {round(model.control_period * NS_PER_S)}
    with pytest.raises(BackendError, match=r"refused the episode.*episode_seed"):
        backend.reset(Start(-1, START.pose))
    drive(backend)


@pytest.mark.parametrize("topic", ["odom", "scan"])
def test_what_is_lost_on_the_way_is_asked_for_again_and_counts_once(
    connect, monkeypatch, topic
):
    backend = connect()
    drive(backend)
    whole = backend.step(np.array([0.5, 0.1]))
    drive(backend)
    put = backend._inbox.put
    lost = []

    def lossy(kind, message):
        if kind == topic and not lost:
            lost.append(kind)
        else:
            put(kind, message)

    monkeypatch.setattr(backend._inbox, "put", lossy)
    holed = backend.step(np.array([0.5, 0.1]))
    assert lost == [topic]
    for name in ("pose", "twist", "ranges"):
        assert np.array_equal(getattr(holed[0], name), getattr(whole[0], name)), name
    assert holed[1][f"{topic}_stamp_ns"] == holed[1]["stamp_ns"]


def test_a_lost_asking_is_made_again(connect, monkeypatch):
    backend = connect()
    drive(backend)
    put = backend._inbox.put
    ask = backend._episodes._repeat.call_async
    lost = []

    def lossy(kind, message):
        if kind == "scan" and "scan" not in lost:
            lost.append(kind)
            return None
        return put(kind, message)

    def deaf(request):
        if "asking" not in lost:
            lost.append("asking")
            return Future()
        return ask(request)

    monkeypatch.setattr("nics_drl_bridge.nodes.link.LOST_S", 0.1)
    monkeypatch.setattr(backend._inbox, "put", lossy)
    monkeypatch.setattr(backend._episodes._repeat, "call_async", deaf)
    view, facts = backend.step(np.array([0.5, 0.1]))
    assert lost == ["scan", "asking"]
    assert view.scan_age_s == 0.0
    assert facts["scan_stamp_ns"] == facts["stamp_ns"]


@pytest.mark.parametrize("topic", ["odom", "scan", "ground_truth"])
def test_a_message_that_cant_be_read_is_told_with_its_topic(
    connect, monkeypatch, topic
):
    backend = connect(truth=True)
    drive(backend)
    put = backend._inbox.put
    monkeypatch.setattr(
        backend._inbox, "put", lambda kind, m: put(kind, m[:14] if kind == topic else m)
    )
    with pytest.raises(BackendError, match=f"topic '{topic}': a message can't be read"):
        backend.step(np.array([0.5, 0.1]))
    monkeypatch.undo()
    drive(backend)


def test_facts_of_a_fleet_have_one_shape_whatever_their_values():
    for later in (3, 4):
        facts = [
            {"stamp_ns": 7, "scan_stamp_ns": stamp, "covariance": np.eye(3)}
            for stamp in (3, later)
        ]
        found = stack_facts(facts)
        assert found["stamp_ns"] == 7
        assert found["scan_stamp_ns"].tolist() == [3, later]
        assert found["covariance"].shape == (2, 3, 3)


def test_after_a_failed_step_a_command_asks_for_a_reset(connect, monkeypatch):
    backend = connect()
    with pytest.raises(BackendError, match=r"no episode has begun; call reset\(\)"):
        backend.send(np.zeros(2))
    drive(backend)
    with monkeypatch.context() as patch:
        patch.setattr(backend._inbox, "put", lambda *_: None)
        patch.setattr(backend, "timeout_s", 0.2)
        with pytest.raises(StaleDataError):
            backend.step(np.array([0.5, 0.0]))
    with pytest.raises(BackendError, match=r"data did not arrive.*call reset\(\)"):
        backend.step(np.array([0.5, 0.0]))
    drive(backend)


@pytest.mark.parametrize("wrong", ["model", "world"])
def test_a_simulator_of_another_model_or_world_is_refused(connect, arena, wrong):
    other = builtin_model("differential")
    if wrong == "world":  # even under the same name
        other = arena.model_copy(update={"size": (6.0, 6.5)})
    backend = connect(**{wrong: other})
    with pytest.raises(ModelError, match=f"'{other.fingerprint}'.*same {wrong}"):
        backend.reset(START)


def test_without_a_simulator_the_error_names_all_that_is_missing(
    model, arena, domain_id
):
    with pytest.raises(BackendError) as caught:
        DdsBackend(model, arena, namespace="car", domain_id=domain_id, timeout_s=0.5)
    for missing in ("cmd_vel", "scan", "odom", "simulator_node/reset"):
        assert f" /car/{missing}" in str(caught.value)
    assert "ground_truth" not in str(caught.value)


@pytest.mark.parametrize("end", ["close", "garbage"])
def test_the_end_of_an_env_leaves_a_zero_command_behind(
    simulator, model, arena, commands_heard, end
):
    env = BridgeEnv("dds", model, arena, backend_options={"domain_id": simulator[0]})
    env.myself = env  # a cycle, which only the collector ends
    env.reset(seed=3)
    backend = env._backend if end == "close" else None

    def act():
        nonlocal env
        if backend is not None:
            env.close()
            env.close()  # twice does no harm
        del env
        gc.collect()

    zero_follows(
        commands_heard, lambda: env.step(np.array([1.0, 0.0], np.float32)), act
    )
    for use in (lambda: backend.step(np.zeros(2)), lambda: backend.reset(START)):
        if backend is not None:
            with pytest.raises(BackendError, match="closed"):
                use()


def test_somebody_else_who_moves_the_simulator_is_found_out(
    connect, commands_heard, monkeypatch
):
    peer, _ = commands_heard
    backend = connect()
    drive(backend)
    intruder = peer.speak(
        Twist, "cmd_vel", subscribers=2
    )  # the simulator, and the listener
    try:
        with monkeypatch.context() as patch:  # first by its deeds alone
            patch.setattr(backend._link, "has_rivals", lambda: False)
            backend.reset(START)
            intruder.publish(Twist())
            peer.until(
                lambda: (
                    backend._take_waiting()
                    or backend._inbox.messages["odom"].stamp_ns > backend._now_ns
                ),
                "its effect",
            )
            with pytest.raises(
                BackendError, match=r"'odom': stamped \+0\.100 s off the step"
            ):
                backend.step(np.array([0.5, 0.0]))
        named = f"/{peer.node.get_name()} publishes /cmd_vel too"
        peer.until(lambda: named in complaint(backend), "the backend sees the intruder")
        with pytest.raises(BackendError, match=named):
            backend.reset(START)
        with pytest.raises(BackendError, match=named):
            backend.step(np.array([0.5, 0.0]))
    finally:
        peer.node.destroy_publisher(intruder)
    peer.until(lambda: not backend._link.has_rivals(), "the intruder is gone")
    drive(backend)


@pytest.mark.process
def test_a_simulator_that_hangs_serves_again_when_it_wakes_and_its_death_is_noticed(
    own_simulator,
):
    backend, process, _ = own_simulator
    drive(backend)
    process._process.send_signal(signal.SIGSTOP)
    backend.timeout_s = 0.5
    hung_ns = backend._now_ns
    with pytest.raises(StaleDataError):
        backend.step(np.array([0.5, 0.0]))
    process._process.send_signal(signal.SIGCONT)
    backend.timeout_s = TIMEOUT_S
    drive(backend)
    assert backend._now_ns > hung_ns
    process._process.kill()
    backend.timeout_s = SHORT_S
    with pytest.raises(StaleDataError, match="no fresh data within 2") as caught:
        backend.step(np.array([0.5, 0.0]))
    assert caught.value.topic == "odom"
    assert SHORT_S < caught.value.age_s < 60.0
    with pytest.raises(BackendError, match="no answer within 2 s"):
        backend.reset(START)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"estimator": False}, "always estimates"),
        ({"randomisation": "mild", "mode": "realtime"}, "only one robot in mode"),
        ({"domian_id": 3}, "did you mean 'domain_id'"),
        ({"namespace": "ant 1"}, "namespace 'ant 1'"),
        ({"robots": 2, "mode": "realtime"}, "a team of 2 robots"),
        ({"robots": 2, "namespaces": ["a"]}, "a team of 2 robots"),
        ({"robots": 2, "namespaces": ["b", "b"]}, "each of them once"),
    ],
)
def test_an_option_that_can_not_be_used_is_refused(model, arena, options, reason):
    with pytest.raises(ConfigError, match=reason):
        dds_backend(model, arena, **options)
