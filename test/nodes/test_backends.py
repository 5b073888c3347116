import gc
from contextlib import closing
from functools import partial
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
from geometry_msgs.msg import Twist
from rclpy.task import Future
from std_srvs.srv import SetBool

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.errors import (
    BackendError,
    ConfigError,
    ModelError,
    StaleDataError,
)
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.interface import NS_PER_S, Start
from nics_drl_bridge.nodes import link, qos
from nics_drl_bridge.nodes.backends import (
    DdsBackend,
    FleetBackend,
    dds_backend,
    stack_facts,
)
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.world import load_world
from nodes.peer import drive_alike

pytestmark = pytest.mark.ros

TIMEOUT_S = 30.0
SHORT_S = 2.0
NAMESPACE = "fleet/car_1"
PAUSE = "simulator_node/pause"
TEAM = {"task": "cooperative_reaching", "task_options": {"robots": 2}}
START = Start(seed=3, pose=np.array([0.5, -0.5, 1.0]))


@pytest.fixture(scope="module")
def arena():
    return load_world("arena")


@pytest.fixture(scope="module")
def simulator(launch, module_domain_id):
    """The domain of a simulator in lock-step."""
    process = launch("simulator_node", module_domain_id, mode="lockstep")
    yield module_domain_id
    process.check()


@pytest.fixture(scope="module")
def backend(simulator, model, arena):
    """A backend on that simulator, for all tests that do not end it."""
    options = {"domain_id": simulator, "timeout_s": TIMEOUT_S, "truth": True}
    with closing(DdsBackend(model, arena, **options)) as made:
        yield made


@pytest.fixture(scope="module")
def left(launch, module_domain_id, meet):
    """A simulator of envs that end, as backend options; commands to it, and who hears them."""
    namespace = "left"
    launch("simulator_node", module_domain_id, namespace=namespace, mode="lockstep")
    peer = meet(module_domain_id, namespace)
    heard = peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)
    options = {"domain_id": module_domain_id, "namespace": namespace}
    return options, heard, peer


def drive(backend, speed=0.5, steps=3):
    backend.reset(START)
    for _ in range(steps):
        backend.step(np.array([speed, 0.0]))


def complaint(backend):
    """Return what a backend says about other publishers, whose names may come late."""
    try:
        backend._link.check_alone()
    except BackendError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("simulated", "arguments", "options"),
    [
        ({}, {}, {"truth": True}),
        ({"world": "mixed.yaml"}, {"world": "mixed.yaml"}, {"truth": True}),
        ({"robots": ["a", "b"]}, TEAM, {"namespaces": ["a", "b"]}),
        ({"randomisation": "strong"}, {"randomisation": "strong"}, {}),
    ],
    ids=["one robot", "maps and moving obstacles", "a team", "randomised"],
)
def test_an_env_over_dds_tells_what_one_in_process_does_bit_for_bit(
    launch, domain_id, model, tmp_path, monkeypatch, simulated, arguments, options
):
    (tmp_path / "mixed.yaml").write_text("worlds: [crowd, room, corridor]\nname: mix\n")
    monkeypatch.chdir(tmp_path)
    launch("simulator_node", domain_id, mode="lockstep", **simulated)
    options = {"domain_id": domain_id, "timeout_s": TIMEOUT_S} | options
    here = BridgeEnv(model=model, estimator=True, **arguments)
    there = BridgeEnv("dds", model, backend_options=options, **arguments)
    with closing(there):
        drive_alike(here, there, (0, 1, 2, 2, 2**31 - 1))


@pytest.mark.parametrize("end", ["error", "close", "garbage"])
def test_the_end_of_an_env_leaves_a_zero_command_behind(left, model, arena, end):
    options, heard, peer = left
    env = BridgeEnv("dds", model, arena, backend_options=options)
    env.myself = env  # a cycle, which only the collector ends
    env.reset(seed=3)

    def drive_on():
        return env.step(np.array([1.0, 0.0], np.float32))

    heard.clear()
    try:
        peer.until(lambda: drive_on() and heard, "a command that is heard")
        if end == "error":
            with pytest.raises(gymnasium.error.InvalidAction):
                env.step(np.full(2, np.nan, np.float32))
        elif end == "close":
            env.close()
            env.close()  # twice does no harm
        else:
            env = None
            gc.collect()
        peer.until(lambda: heard and heard[-1] == Twist(), "a zero command")
    finally:
        if env is not None:
            env.close()
    if end == "close":
        with pytest.raises(BackendError, match="closed"):
            env._backend.step(np.zeros(2))
        with pytest.raises(BackendError, match="closed"):
            env._backend.reset(START)


def test_each_view_is_of_the_step_and_one_control_period_after_the_last(backend, model):
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


@pytest.mark.parametrize("lost", [["odom"], ["scan", "request"]])
def test_what_is_lost_on_the_way_is_requested_again_and_counts_once(
    backend, monkeypatch, lost
):
    drive(backend)
    whole = backend.step(np.array([0.5, 0.1]))
    drive(backend)
    call = backend._episodes._repeat.call_async
    left = list(lost)

    def lose(what):
        if what in left:
            left.remove(what)
            return True
        return False

    monkeypatch.setattr("nics_drl_bridge.nodes.link.LOST_S", 0.1)

    class Lossy(dict):
        def __setitem__(self, topic, message):
            if not lose(topic):
                super().__setitem__(topic, message)

    monkeypatch.setattr(backend._inbox, "messages", Lossy(backend._inbox.messages))
    monkeypatch.setattr(
        backend._episodes._repeat,
        "call_async",
        lambda request: Future() if lose("request") else call(request),
    )
    holed = backend.step(np.array([0.5, 0.1]))
    assert left == []
    for name in ("pose", "twist", "ranges"):
        assert np.array_equal(getattr(holed[0], name), getattr(whole[0], name)), name
    assert holed[1][f"{lost[0]}_stamp_ns"] == holed[1]["stamp_ns"]


@pytest.mark.parametrize("topic", ["odom", "scan", "ground_truth"])
def test_a_message_that_cant_be_read_is_told_with_its_topic(
    backend, monkeypatch, topic
):
    drive(backend)
    read = link.read_message
    monkeypatch.setattr(
        link,
        "read_message",
        lambda kind, how, m: read(kind, how, m[:8] if kind == topic else m),
    )
    with pytest.raises(BackendError, match=f"topic '{topic}': a message can't be read"):
        backend.step(np.array([0.5, 0.1]))


def test_an_answer_that_the_simulator_could_not_deliver_is_asked_for_again(
    backend, monkeypatch
):
    monkeypatch.setattr("nics_drl_bridge.nodes.link.LOST_S", 0.1)
    test = backend._episodes._test
    call = test.call_async
    asked = []

    def lose_every_other(request):
        asked.append(request)
        return Future() if len(asked) % 2 else call(request)

    monkeypatch.setattr(test, "call_async", lose_every_other)
    assert backend.reset(START).pose == pytest.approx(START.pose)
    assert len(asked) >= 4  # before and after the reset, which must happen only once


@pytest.mark.parametrize("end", ["halt", "close"])
def test_one_robot_of_a_fleet_that_cant_be_halted_keeps_none_of_the_others_moving(end):
    fleet = FleetBackend.__new__(FleetBackend)
    fleet._robots = [
        Mock(),
        Mock(**{f"{end}.side_effect": BackendError("deaf")}),
        Mock(),
    ]
    with pytest.raises(BackendError, match="deaf"):
        getattr(fleet, end)()
    for robot in fleet._robots:
        getattr(robot, end).assert_called_once_with()


def test_facts_of_a_fleet_are_stacked_except_the_time_that_all_share():
    facts = [{"stamp_ns": 7, "covariance": k * np.eye(3)} for k in range(2)]
    stacked = stack_facts(facts)
    assert stacked["stamp_ns"] == 7
    assert stacked["covariance"].tolist() == [
        np.zeros((3, 3)).tolist(),
        np.eye(3).tolist(),
    ]


def test_after_a_failed_step_a_command_asks_for_a_reset(backend, monkeypatch):
    drive(backend)
    with monkeypatch.context() as patch:
        patch.setattr(backend._inbox, "has", lambda *_: False)
        patch.setattr(backend, "timeout_s", 0.2)
        with pytest.raises(StaleDataError):
            backend.step(np.array([0.5, 0.0]))
    with pytest.raises(BackendError, match=r"data did not arrive.*call reset\(\)"):
        backend.step(np.array([0.5, 0.0]))
    drive(backend)


@pytest.mark.parametrize("wrong", ["model", "world", "randomisation"])
def test_a_simulator_of_another_model_world_or_randomisation_is_refused(
    backend, arena, monkeypatch, wrong
):
    others = {
        "model": builtin_model("differential"),
        "world": arena.model_copy(update={"size": (6.0, 6.5)}),  # of the same name
        "randomisation": load_randomisation("mild"),
    }
    other = others[wrong].fingerprint
    monkeypatch.setitem(backend._episodes._identity, wrong, other)
    with pytest.raises(ModelError, match=f"'{other}'.*same {wrong}"):
        backend.reset(START)


def test_without_a_simulator_the_error_names_all_that_is_missing(
    model, arena, domain_id
):
    with pytest.raises(BackendError) as caught:
        DdsBackend(model, arena, namespace="car", domain_id=domain_id, timeout_s=0.5)
    for missing in ("cmd_vel", "scan", "odom", "simulator_node/reset"):
        assert f" /car/{missing}" in str(caught.value)
    assert "ground_truth" not in str(caught.value)


def test_somebody_else_who_moves_the_simulator_is_found_out(
    backend, simulator, meet, monkeypatch
):
    peer = meet(simulator)
    drive(backend)
    intruder = peer.speak(Twist, "cmd_vel")
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


def test_a_simulator_that_hangs_serves_again_when_it_wakes_and_its_death_is_noticed(
    launch, meet, domain_id, model, arena
):
    process = launch("simulator_node", domain_id, namespace=NAMESPACE, mode="lockstep")
    options = {"namespace": NAMESPACE, "domain_id": domain_id, "timeout_s": TIMEOUT_S}
    with closing(DdsBackend(model, arena, **options)) as backend:
        drive(backend)
        pause = partial(meet(domain_id).call, SetBool, f"{NAMESPACE}/{PAUSE}")
        pause(SetBool.Request(data=True))
        backend.timeout_s = 0.5
        hung_ns = backend._now_ns
        with pytest.raises(StaleDataError):
            backend.step(np.array([0.5, 0.0]))
        pause(SetBool.Request(data=False))
        backend.timeout_s = TIMEOUT_S
        drive(backend)
        assert backend._now_ns > hung_ns
        process.close()
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
