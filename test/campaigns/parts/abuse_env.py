"""Abuse of an env over DDS: does a motion stay on `cmd_vel` after an exception has left it?

A simulator in real time, whose commands hold for an hour, drives because the env says so. Then
something is thrown: by the task, the picture, the backend, Ctrl-C at any moment, or by the env
itself because of what it was given. A node of its own listens to `cmd_vel` and to the truth.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from parts.abuse import Score
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

GRACE_S, WATCH_S = 0.25, 1.2
"""A motion on `cmd_vel` so long after the exception has stayed; it is watched for so long."""
MOVES_S = 5.0
HANGS_S = 10.0
TRIES = 3
MOVING = 0.05
ROBOT = "ackermann"
AHEAD = np.array([1.0, 0.0], np.float32)
METHODS = ("command", "reset", "step_into")
ERRORS = (ValueError, ZeroDivisionError, MemoryError, KeyboardInterrupt, SystemExit)
Rng = np.random.Generator
Throw = Callable[[BridgeEnv, Rng], None]


class Watcher:
    """Listens in a thread of its own.

    Attributes:
        said: (time [s], moves) of each command.
        speed: of the robot, as the simulator knows it [m/s].
    """

    def __init__(self, domain_id: int) -> None:
        self.said: list[tuple[float, bool]] = []
        self.speed = 0.0
        self._context = open_context(domain_id=domain_id)
        self._node = Node(
            "watcher", context=self._context, start_parameter_services=False
        )
        self._node.create_subscription(Twist, "cmd_vel", self._hear, qos.EVERY_COMMAND)
        self._node.create_subscription(Odometry, "ground_truth", self._see, qos.SENSOR)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _hear(self, message: Twist) -> None:
        told = message.linear.x, message.linear.y, message.angular.z
        self.said.append(
            (time.monotonic(), told != (0.0, 0.0, 0.0))
        )  # NaN is a motion too

    def _see(self, message: Odometry) -> None:
        self.speed = abs(message.twist.twist.linear.x)

    def _spin(self) -> None:
        with contextlib.suppress(Exception):  # the context is shut down
            while self._context.ok():
                self._executor.spin_once(timeout_sec=0.1)

    def moves_after(self, instant_s: float) -> bool:
        """Whether a motion is on `cmd_vel` at an instant or comes afterwards."""
        before = [moves for time_s, moves in list(self.said) if time_s <= instant_s]
        after = [moves for time_s, moves in list(self.said) if time_s > instant_s]
        return any([*before[-1:], *after])

    def close(self) -> None:
        """Leaves the graph."""
        self._context.try_shutdown()
        self._thread.join(timeout=2.0)


class Thrower(Navigation):
    """Throws from one of its methods, or turns its command into nonsense, when it is told to."""

    throws = SimpleNamespace(method="", error=None, nonsense=None)

    def command(self, action: Any) -> Any:
        self._at("command")
        right = super().command(action)
        return right if self.throws.nonsense is None else self.throws.nonsense(right)

    def reset(self, episodes: Any) -> Any:
        self._at("reset")
        return super().reset(episodes)

    def step_into(self, *given: Any) -> Any:
        self._at("step_into")
        return super().step_into(*given)

    def _at(self, method: str) -> None:
        if self.throws.method == method:
            raise self.throws.error


def planned(**what: Any) -> None:
    """Tells the task what to do from now on; nothing where nothing is given."""
    vars(Thrower.throws).update({"method": "", "error": None, "nonsense": None} | what)


def bad_action(env: BridgeEnv, rng: Rng) -> None:
    """Hands in an action that is none."""
    spoilt = AHEAD.copy()
    spoilt[rng.integers(2)] = rng.choice([np.nan, np.inf, -np.inf])
    choices: list[Any] = [
        spoilt,
        spoilt,
        np.ones(int(rng.integers(3, 9)), np.float32),
        np.float32(1.0),
        None,
        "ahead",
        [[AHEAD]],
        [AHEAD, 1.0],
        {"speed": 1.0},
        AHEAD * 1j * np.nan,
        object(),
        np.ones((0, 2)),
        np.array(["a", "b"]),
    ]
    env.step(choices[rng.integers(len(choices))])


def bad_seed(env: BridgeEnv, rng: Rng) -> None:
    """Begins an episode by a seed that is none."""
    great = 2 ** int(rng.integers(63, 5000))
    choices: list[Any] = [
        -1,
        -great,
        great,
        2**63,
        1.5,
        float("nan"),
        "three",
        [1],
        np.ones(3),
    ]
    env.reset(seed=choices[rng.integers(len(choices))])


def bad_options(env: BridgeEnv, rng: Rng) -> None:
    """Begins an episode with options that are none."""
    size = int(rng.integers(4, 9))
    choices: list[Any] = [
        {"start": "there"},
        {"start": (1.0,)},
        {"goal": np.nan},
        {"goal": np.ones(size)},
        {"goal": object()},
        {"strat": (0.0, 0.0, 0.0)},
        {3: 4},
        [1],
        "start",
        7,
        {"start": None},
        {"start": (np.inf, 0.0, 0.0)},
    ]
    env.reset(seed=int(rng.integers(100)), options=choices[rng.integers(len(choices))])


def raising_task(env: BridgeEnv, rng: Rng) -> None:
    """Lets a method of the task raise."""
    method = METHODS[rng.integers(len(METHODS))]
    planned(method=method, error=ERRORS[rng.integers(len(ERRORS))]("thrown"))
    if method == "reset":
        env.reset(seed=int(rng.integers(100)))
    env.step(AHEAD)


def senseless_task(env: BridgeEnv, rng: Rng) -> None:
    """Lets the task command what no robot can be told."""
    nonsense: list[Callable[[Any], Any]] = [
        lambda right: right * np.nan,
        lambda right: right / 0.0,
        lambda right: right[..., :1],
        lambda right: None,
        lambda right: "ahead",
        lambda right: right * -np.inf,
    ]
    planned(nonsense=nonsense[rng.integers(len(nonsense))])
    with np.errstate(all="ignore"):
        env.step(AHEAD)


def raising_picture(env: BridgeEnv, rng: Rng) -> None:
    """Draws, or closes, a picture that raises."""

    def fails(*_: Any) -> None:
        raise ERRORS[rng.integers(len(ERRORS))]("thrown")

    env._picture = SimpleNamespace(draw=fails, close=fails)
    (env.render if rng.random() < 0.5 else env.close)()


def raising_backend(env: BridgeEnv, rng: Rng) -> None:
    """Lets what the backend is made of raise amid a step."""
    part = ("_fresh_view", "_oldest")[rng.integers(2)]
    error = ERRORS[rng.integers(len(ERRORS))]("thrown")
    with mock.patch.object(env._backend, part, side_effect=error):
        env.step(AHEAD)


def interrupted(env: BridgeEnv, rng: Rng) -> None:
    """Presses Ctrl-C at some moment of a drive."""
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, float(rng.uniform(0.01, 0.6)))
        while True:
            if env.step(AHEAD)[2]:
                env.reset()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def bad_call(env: BridgeEnv, rng: Rng) -> None:
    """Calls a method with arguments that it does not have."""
    calls: list[Callable[[], Any]] = [
        lambda: env.step(),
        lambda: env.reset(3),
        lambda: env.reset(sed=1),  # type: ignore[call-arg,misc]
        lambda: env.render("human"),
        lambda: env.close(1),  # type: ignore[call-arg]
    ]
    calls[rng.integers(len(calls))]()


OF_THE_USER = (bad_action, bad_seed, bad_options)
"""What has to be answered by one sentence."""
PLACES: tuple[Throw, ...] = (
    *OF_THE_USER,
    raising_task,
    senseless_task,
    raising_picture,
    raising_backend,
    interrupted,
    bad_call,
)


def make_env(domain_id: int) -> BridgeEnv:
    """An env in real time whose task and picture can be made to throw."""
    options = {"mode": "realtime", "domain_id": domain_id, "stale_after_s": 60.0}
    made = gymnasium.make(
        "NicsBridge/Task-v0",
        backend="dds",
        model=ROBOT,
        world="empty",
        task=Thrower,
        render_mode="rgb_array",
        backend_options=options,
    )
    env = made.unwrapped
    assert isinstance(env, BridgeEnv)
    return env


def drives(env: BridgeEnv, watcher: Watcher, seed: int) -> bool:
    """Whether the robot moved, and a motion is on `cmd_vel`."""
    env.reset(seed=seed)
    watcher.said.clear()
    deadline = time.monotonic() + MOVES_S
    while time.monotonic() < deadline:
        if env.step(AHEAD)[2]:
            env.reset()
        if watcher.speed > MOVING and watcher.said and watcher.said[-1][1]:
            return True
    return False


def thrown(env: BridgeEnv, place: Throw, rng: Rng) -> BaseException | None:
    """What comes of abusing an env."""
    try:
        place(env, rng)
    except BaseException as error:  # noqa: BLE001  (Ctrl-C is among what is thrown)
        return error
    finally:
        planned()
    return None


def judge(
    score: Score, line: str, place: Throw, error: BaseException | None, took_s: float
) -> None:
    """Counts what an env must not answer."""
    if error is None:
        score.count("accepted", line)
    elif place in OF_THE_USER and not isinstance(
        error, BridgeError | gymnasium.error.Error
    ):
        score.count("tracebacks", f"{line}: {type(error).__name__}: {error}")
    if took_s > HANGS_S:
        score.count("hangs", f"{line}: {took_s:.1f} s")


def abuse(score: Score, env: BridgeEnv, watcher: Watcher, rng: Rng, line: str) -> None:
    """One round: drives, throws, watches."""
    for _ in range(TRIES):
        if drives(env, watcher, int(rng.integers(1000))):
            break
    else:
        raise RuntimeError(
            f"{line}: the robot does not move, so that nothing can be measured"
        )
    place = PLACES[rng.integers(len(PLACES))]
    began = time.monotonic()
    error = thrown(env, place, rng)
    left = time.monotonic()
    score.tries += 1
    line = f"{line}, {place.__name__} ({type(error).__name__}: {str(error)[:80]})"
    judge(score, line, place, error, left - began)
    time.sleep(WATCH_S)
    if watcher.moves_after(left + GRACE_S):
        score.count("moved", line)


@contextlib.contextmanager
def weakened(control: str | None) -> Iterator[None]:
    """Takes out what a control takes out."""
    if control is None:
        yield
        return
    with mock.patch.object(Link, "halt"):
        yield


def campaign(seed: int, rounds: int, control: str | None = None) -> Score:
    """Drives and throws so many times.

    Args:
        seed: of what is thrown, and from where.
        rounds: each takes some seconds.
        control: `no_guard`, or None.

    Raises:
        RuntimeError: the robot did not move, so that nothing was measured.
    """
    score = Score()
    rng = np.random.default_rng(seed)
    domain_id = free_domain_id()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        parameters = {
            "model": ROBOT,
            "world": "empty",
            "mode": "realtime",
            "command_timeout": 3600.0,
        }
        parameters["enable_stamped_cmd_vel"] = False
        node = stack.enter_context(
            NodeProcess("simulator_node", folder, parameters, domain_id)
        )
        watcher = Watcher(domain_id)
        stack.callback(watcher.close)
        stack.enter_context(weakened(control))
        env = make_env(domain_id)
        for k in range(rounds):
            node.check()
            if not env._backend._link._closing.alive:  # a round has closed it
                env = make_env(domain_id)
            abuse(score, env, watcher, rng, f"seed {seed}, round {k}")
        env._picture = None
        env.close()
    return score


if __name__ == "__main__":
    found = campaign(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
    print(vars(found))
