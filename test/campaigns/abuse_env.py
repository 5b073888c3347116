"""Does a motion stay on `cmd_vel` after an exception has left an env over DDS?

A simulator in real time, whose commands hold for an hour, drives because the env says so. Then
something is thrown: by the task, the picture, the backend, Ctrl-C at any moment, or by the env
itself because of what it was given. A node of its own listens to `cmd_vel` and to the truth.
"""

from __future__ import annotations

import contextlib
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id
from nics_drl_bridge.nodes.spun_node import SpunNode

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
BARS = {
    **dict.fromkeys(("moved", "tracebacks", "hangs", "accepted"), at_most(0)),
    "tries": at_least(1),
}
Rng = np.random.Generator


class Watcher(SpunNode):
    """Listens in a thread of its own.

    Attributes:
        said: (time [s], moves) of each command.
        speed: of the robot, as the simulator knows it [m/s].
    """

    def __init__(self, domain_id: int) -> None:
        super().__init__("watcher", domain_id)
        self.said: list[tuple[float, bool]] = []
        self.speed = 0.0
        self._ended = False
        self.node.create_subscription(Twist, "cmd_vel", self._hear, qos.EVERY_COMMAND)
        self.node.create_subscription(Odometry, "ground_truth", self._see, qos.SENSOR)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _hear(self, message: Twist) -> None:
        told = message.linear.x, message.linear.y, message.angular.z
        moves = told != (0.0, 0.0, 0.0)  # NaN is a motion too
        self.said.append((time.monotonic(), moves))

    def _see(self, message: Odometry) -> None:
        self.speed = abs(message.twist.twist.linear.x)

    def _listen(self) -> None:
        while not self._ended:
            self.spin(0.1)

    def moves_after(self, instant_s: float) -> bool:
        """Whether a motion is on `cmd_vel` at an instant or comes afterwards."""
        before = [moves for time_s, moves in list(self.said) if time_s <= instant_s]
        after = [moves for time_s, moves in list(self.said) if time_s > instant_s]
        return any([*before[-1:], *after])

    def close(self) -> None:
        self._ended = True
        self._thread.join(timeout=2.0)
        super().close()


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


def plan(**what: Any) -> None:
    """Tells the task what to do from now on; nothing where nothing is given."""
    vars(Thrower.throws).update({"method": "", "error": None, "nonsense": None} | what)


def _spoil(rng: Rng) -> Any:
    spoilt = AHEAD.copy()
    spoilt[rng.integers(2)] = rng.choice([np.nan, np.inf, -np.inf])
    return spoilt


def _pick(rng: Rng, choices: Any) -> Any:
    return choices[rng.integers(len(choices))]


ACTIONS: tuple[Any, ...] = (np.ones(3, np.float32), None, [AHEAD, 1.0], object())
SEEDS: tuple[Any, ...] = (-1, 2**4999, 1.5, "three")
OPTIONS: tuple[Any, ...] = ({"start": (1.0,)}, {"goal": np.nan}, {3: 4}, [1])
COMMANDS: tuple[Callable[[Any], Any], ...] = (
    lambda right: right * np.nan,
    lambda right: right[..., :1],
    lambda right: None,
    lambda right: right * -np.inf,
)
CALLS: tuple[Callable[[Any], Any], ...] = (
    lambda env: env.step(),
    lambda env: env.reset(3),
    lambda env: env.close(1),
)


def give_bad_action(env: BridgeEnv, rng: Rng) -> None:
    env.step(_spoil(rng) if rng.random() < 0.2 else _pick(rng, ACTIONS))


def give_bad_seed(env: BridgeEnv, rng: Rng) -> None:
    env.reset(seed=_pick(rng, SEEDS))


def give_bad_options(env: BridgeEnv, rng: Rng) -> None:
    env.reset(seed=int(rng.integers(100)), options=_pick(rng, OPTIONS))


def make_bad_call(env: BridgeEnv, rng: Rng) -> None:
    _pick(rng, CALLS)(env)


def let_task_raise(env: BridgeEnv, rng: Rng) -> None:
    method = _pick(rng, METHODS)
    plan(method=method, error=_pick(rng, ERRORS)("thrown"))
    if method == "reset":
        env.reset(seed=int(rng.integers(100)))
    env.step(AHEAD)


def let_task_command_nonsense(env: BridgeEnv, rng: Rng) -> None:
    plan(nonsense=_pick(rng, COMMANDS))
    with np.errstate(all="ignore"):
        env.step(AHEAD)


def let_picture_raise(env: BridgeEnv, rng: Rng) -> None:
    """Draws, or closes, a picture that raises."""
    fails = mock.Mock(side_effect=_pick(rng, ERRORS)("thrown"))
    env._picture = SimpleNamespace(draw=fails, close=fails)
    (env.render if rng.random() < 0.5 else env.close)()


def let_backend_raise(env: BridgeEnv, rng: Rng) -> None:
    """Lets what the backend is made of raise amid a step."""
    error = _pick(rng, ERRORS)("thrown")
    part = _pick(rng, ("_fresh_view", "_oldest"))
    with mock.patch.object(env._backend, part, side_effect=error):
        env.step(AHEAD)


def interrupt(env: BridgeEnv, rng: Rng) -> None:
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


OF_THE_USER = (give_bad_action, give_bad_seed, give_bad_options)
"""What has to be answered by one sentence."""
PLACES: tuple[Callable[[BridgeEnv, Rng], None], ...] = (
    *OF_THE_USER,
    make_bad_call,
    let_task_raise,
    let_task_command_nonsense,
    let_picture_raise,
    let_backend_raise,
    interrupt,
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


def drive(env: BridgeEnv, watcher: Watcher, seed: int) -> bool:
    """Drives; returns whether the robot moved, and a motion is on `cmd_vel`."""
    env.reset(seed=seed)
    watcher.said.clear()
    deadline = time.monotonic() + MOVES_S
    while time.monotonic() < deadline:
        if env.step(AHEAD)[2]:
            env.reset()
        if watcher.speed > MOVING and watcher.said and watcher.said[-1][1]:
            return True
    return False


def abuse(env: BridgeEnv, watcher: Watcher, rng: Rng) -> tuple[str, list[str]]:
    """One round: drives, throws, watches; returns what was thrown, and the bars it missed.

    Raises:
        RuntimeError: the robot did not move, so that nothing was measured.
    """
    if not any(drive(env, watcher, int(rng.integers(1000))) for _ in range(TRIES)):
        raise RuntimeError("the robot does not move, so that nothing can be measured")
    place = _pick(rng, PLACES)
    error: BaseException | None = None
    began = time.monotonic()
    try:
        place(env, rng)
    except BaseException as raised:  # noqa: BLE001  (Ctrl-C is among what is thrown)
        error = raised
    finally:
        plan()
    left = time.monotonic()
    time.sleep(WATCH_S)
    sentences = (BridgeError, gymnasium.error.Error)
    missed = {
        "accepted": error is None,
        "tracebacks": place in OF_THE_USER and not isinstance(error, sentences),
        "hangs": left - began > HANGS_S,
        "moved": watcher.moves_after(left + GRACE_S),
    }
    told = f"{place.__name__} ({type(error).__name__}: {str(error)[:80]})"
    return told, [bar for bar, wrong in missed.items() if wrong]


def measure(given: Given) -> Result:
    """Drives and throws so many times; each round takes some seconds."""
    result: Result = dict.fromkeys(BARS, 0) | {"told": []}
    rng = np.random.default_rng(given.seed)
    domain_id = free_domain_id()
    parameters = {
        "model": ROBOT,
        "world": "empty",
        "mode": "realtime",
        "command_timeout": 3600.0,
        "enable_stamped_cmd_vel": False,
    }
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        simulator = NodeProcess("simulator_node", folder, parameters, domain_id)
        node = stack.enter_context(simulator)
        watcher = Watcher(domain_id)
        stack.callback(watcher.close)
        if given.control == "no_guard":
            stack.enter_context(mock.patch.object(Link, "halt"))
        env = make_env(domain_id)
        for k in range(given.rounds):
            node.check()
            if not env._backend._link._closing.alive:  # a round has closed it
                env = make_env(domain_id)
            told, missed = abuse(env, watcher, rng)
            result["tries"] += 1
            for bar in missed:
                result[bar] += 1
                result["told"].append(f"{bar}: seed {given.seed}, round {k}, {told}")
        env._picture = None
        env.close()
    return result


if __name__ == "__main__":
    run_campaign(measure, BARS, {"seed": 0, "rounds": 100})
