"""An env over DDS leaves a zero on `cmd_vel` when an exception leaves one of its methods."""

import threading
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from geometry_msgs.msg import Twist

from nics_drl_bridge.env.registry import COOPERATIVE_REACHING, NAVIGATION
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import link, qos

pytestmark = pytest.mark.ros

AHEAD = np.array([1.0, 0.0], np.float32)
PATIENCE_S = 60.0


class Thrower(Navigation):
    """Drives as commanded until `error` is set, which the next call raises."""

    thrown = SimpleNamespace(error=None, value=None)

    def command(self, action):
        if self.thrown.error is not None:
            raise self.thrown.error
        command = super().command(action)
        return command if self.thrown.value is None else command * self.thrown.value

    def reset(self, episodes):
        if self.thrown.error is not None:
            raise self.thrown.error
        return super().reset(episodes)


@pytest.fixture(scope="module")
def simulators(launch, domains):
    """Return the domain of a simulator for each mode."""
    from domains import claimed_domain

    found = {}
    for mode in ("realtime", "lockstep"):
        found[mode] = domains.enter_context(claimed_domain())
        # A command holds for an hour: what stops the robot is the env.
        launch(
            "simulator_node",
            found[mode],
            mode=mode,
            world="empty",
            command_timeout=3600.0,
        )
    return found


@pytest.fixture(scope="module")
def listeners(simulators, meet):
    """Return what is published on `cmd_vel` in each mode."""
    peers = {mode: meet(domain_id) for mode, domain_id in simulators.items()}
    return {
        mode: (peer, peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND))
        for mode, peer in peers.items()
    }


@pytest.fixture
def driving(simulators, listeners):
    """Make an env whose robot drives ahead, `driving(mode)`, and which listeners have found."""
    made = []
    Thrower.thrown.error = Thrower.thrown.value = None

    def start(mode, **arguments):
        peer, heard = listeners[mode]
        options = {"mode": mode, "domain_id": simulators[mode]}
        options |= {"stale_after_s": PATIENCE_S} if mode == "realtime" else {}
        env = gymnasium.make(
            NAVIGATION,
            backend="dds",
            model="ackermann",
            world="empty",
            task=Thrower,
            max_episode_steps=100_000,
            backend_options=options,
            **arguments,
        )
        made.append(env)
        env.reset(seed=1)
        drive_on(env, peer, heard)
        return env, peer, heard

    yield start
    Thrower.thrown.error = Thrower.thrown.value = None
    for env in made:
        env.close()


def step(env):
    ended = env.step(AHEAD)[2]
    if ended:
        env.reset()
    return True


def drive_on(env, peer, heard):
    heard.clear()
    peer.until(
        lambda: step(env) and heard and heard[-1].linear.x > 0.0, "that it drives"
    )


def throw(error=None, value=None):
    Thrower.thrown.error, Thrower.thrown.value = error, value


def say_nan(env):
    throw(value=np.nan)
    env.step(AHEAD)


def interrupt(env):
    throw(KeyboardInterrupt())
    env.step(AHEAD)


def raise_in_reset(env):
    throw(ZeroDivisionError("of the task"))
    env.reset(seed=2)


CASES = {
    "a task whose command is NaN": (say_nan, ConfigError),
    "a task whose reset raises": (raise_in_reset, ZeroDivisionError),
    "Ctrl-C in step": (interrupt, KeyboardInterrupt),
}


@pytest.mark.parametrize(
    "mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.campaign)]
)
def test_a_zero_is_the_last_that_cmd_vel_hears(driving, mode):
    """Each case of the guard is tested in process; over topics one drive meets them in turn."""
    env, peer, heard = driving(mode)
    for act, error in CASES.values():
        with pytest.raises(error):
            act(env)
        peer.until(lambda: heard[-1] == Twist(), "a zero command")
        assert np.isfinite([(one.linear.x, one.angular.z) for one in heard]).all()
        throw()
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(AHEAD)
        env.reset(seed=2)
        drive_on(env, peer, heard)


def test_a_command_that_no_other_one_follows_is_followed_by_a_zero(driving):
    """Its sender may have died of an error that the env never saw."""
    env, peer, heard = driving("realtime")
    with pytest.raises(TypeError):
        env.step()  # refused by a wrapper: the env is not asked
    peer.until(lambda: heard[-1] == Twist(), "a zero command")
    known = len(heard)
    # Nothing has been lost by it; one command alone may be overtaken by the zero that follows it.
    moves = lambda: any(each.linear.x > 0.0 for each in heard[known:])  # noqa: E731
    peer.until(lambda: step(env) and moves(), "a command")
    peer.until(lambda: heard[-1] == Twist(), "another zero command")


def test_the_death_of_the_thread_that_listens_leaves_a_zero_behind(
    driving, monkeypatch
):
    spin_once = link.SingleThreadedExecutor.spin_once

    def dies(*given, **options):
        if threading.current_thread().name == "dds_backend":
            raise MemoryError("in the executor")
        return spin_once(*given, **options)

    monkeypatch.setattr(threading, "excepthook", lambda *_: None)
    env, peer, heard = driving("realtime")
    env.step(AHEAD)
    monkeypatch.setattr(link.SingleThreadedExecutor, "spin_once", dies)
    peer.until(lambda: heard[-1] == Twist(), "a zero command")
    peer.until(
        lambda: not env.unwrapped._backend._link._context.ok(), "the thread's end"
    )
    with pytest.raises(BackendError, match="closed"):
        env.step(AHEAD)


def test_one_robot_of_a_fleet_that_cant_be_halted_keeps_none_of_the_others_moving(
    launch, meet, domain_id, monkeypatch
):
    names = ["a", "b", "c"]
    launch("simulator_node", domain_id, mode="lockstep", robots=names, world="empty")
    peer = meet(domain_id)
    heard = [peer.listen(Twist, f"{name}/cmd_vel", qos.EVERY_COMMAND) for name in names]
    env = gymnasium.make(
        COOPERATIVE_REACHING,
        backend="dds",
        model="ackermann",
        world="empty",
        task_options={"robots": 3},
        backend_options={"domain_id": domain_id, "namespaces": names},
    ).unwrapped

    def drive():
        ended = env.step(np.tile(AHEAD, 3))[2]
        if ended:
            env.reset()
        return all(each and each[-1].linear.x > 0.0 for each in heard)

    def refuse():
        raise BackendError("can't be halted")

    env.reset(seed=0)
    peer.until(drive, "that all drive")
    deaf = env._backend._robots[1]
    try:
        with monkeypatch.context() as patch:
            patch.setattr(deaf, "halt", refuse)
            with pytest.raises(BackendError, match="can't be halted"):
                env.step(np.tile(AHEAD, 3) * np.nan)
        for others in (heard[0], heard[2]):
            peer.until(lambda others=others: others[-1] == Twist(), "zeros")
        env.reset(seed=0)
        peer.until(drive, "that all drive")
        monkeypatch.setattr(deaf, "close", refuse)
        with pytest.raises(BackendError, match="can't be halted"):
            env.close()
        peer.until(lambda: all(each[-1] == Twist() for each in heard[::2]), "zeros")
    finally:
        deaf._link.close()
