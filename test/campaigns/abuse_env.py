"""Does a motion stay on `cmd_vel` after an exception has left an env over DDS?

A simulator in real time, whose commands hold for an hour, drives because the env says so. Then
something is thrown: by the task, by Ctrl-C at any moment, or by the env itself because of what it
was given. A node of its own listens to `cmd_vel` and to the truth.
"""

from __future__ import annotations

import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
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
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

GRACE_S = 0.25  # after the exception, for the last motion on `cmd_vel`
WATCH_S = 1.2
MOVES_S = 15.0
HANGS_S = 10.0
MOVING = 0.05  # [m/s]
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
    """Listens in a thread of its own."""

    def __init__(self, domain_id: int) -> None:
        super().__init__("watcher", domain_id)
        self.said: list[
            tuple[float, bool]
        ] = []  # time of each command [s]; does it move?
        self.speed = 0.0  # true one of the robot [m/s]
        self.node.create_subscription(Twist, "cmd_vel", self._hear, qos.EVERY_COMMAND)
        self.node.create_subscription(Odometry, "ground_truth", self._see, qos.SENSOR)
        self.start()

    def _hear(self, message: Twist) -> None:
        told = message.linear.x, message.linear.y, message.angular.z
        moves = told != (0.0, 0.0, 0.0)  # NaN is a motion too
        self.said.append((time.monotonic(), moves))

    def _see(self, message: Odometry) -> None:
        self.speed = abs(message.twist.twist.linear.x)

    def sees_motion_after(self, instant_s: float) -> bool:
        """Returns whether a motion is on `cmd_vel` at an instant or comes afterwards."""
        said = list(self.said)
        before = [moves for time_s, moves in said if time_s <= instant_s]
        after = [moves for time_s, moves in said if time_s > instant_s]
        return any([*before[-1:], *after])


class Thrower(Navigation):
    """Throws from one of its methods, or turns its command into nonsense, when it is told to."""

    method = ""
    error: BaseException = ValueError()
    spoil: Callable[[Any], Any] | None = None

    def command(self, action: Any) -> Any:
        self._throw("command")
        right = super().command(action)
        return right if Thrower.spoil is None else Thrower.spoil(right)

    def reset(self, episodes: Any) -> Any:
        self._throw("reset")
        return super().reset(episodes)

    def step_into(self, *given: Any) -> Any:
        self._throw("step_into")
        return super().step_into(*given)

    def _throw(self, method: str) -> None:
        if Thrower.method == method:
            raise Thrower.error


ACTIONS: tuple[Any, ...] = (
    *(np.array([bad, 0.0], np.float32) for bad in (np.nan, np.inf, -np.inf)),
    np.ones(3, np.float32),
    None,
    [AHEAD, 1.0],
    object(),
)
SEEDS: tuple[Any, ...] = (-1, 2**4999, 1.5, "three")
OPTIONS: tuple[Any, ...] = ({"start": (1.0,)}, {"goal": np.nan}, {3: 4}, [1])
COMMANDS: tuple[Callable[[Any], Any], ...] = (
    lambda right: right * np.nan,
    lambda right: right[..., :1],
    lambda right: None,
    lambda right: right * -np.inf,
)


def pick(rng: Rng, choices: Any) -> Any:
    return choices[rng.integers(len(choices))]


def give_bad_action(env: BridgeEnv, rng: Rng) -> None:
    with np.errstate(invalid="ignore"):
        env.step(pick(rng, ACTIONS))


def give_bad_seed(env: BridgeEnv, rng: Rng) -> None:
    env.reset(seed=pick(rng, SEEDS))


def give_bad_options(env: BridgeEnv, rng: Rng) -> None:
    env.reset(seed=int(rng.integers(100)), options=pick(rng, OPTIONS))


def let_task_raise(env: BridgeEnv, rng: Rng) -> None:
    Thrower.error = pick(rng, ERRORS)("thrown")
    Thrower.method = pick(rng, METHODS)
    if Thrower.method == "reset":
        env.reset(seed=int(rng.integers(100)))
    env.step(AHEAD)


def let_task_command_nonsense(env: BridgeEnv, rng: Rng) -> None:
    Thrower.spoil = pick(rng, COMMANDS)
    with np.errstate(all="ignore"):
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


# what has to be answered by one sentence
OF_THE_USER = (give_bad_action, give_bad_seed, give_bad_options)
PLACES: tuple[Callable[[BridgeEnv, Rng], None], ...] = (
    *OF_THE_USER,
    let_task_raise,
    let_task_command_nonsense,
    interrupt,
)


def make_env(domain_id: int) -> BridgeEnv:
    """Makes an env in real time whose task can be made to throw."""
    options = {"mode": "realtime", "domain_id": domain_id, "stale_after_s": 60.0}
    made = gymnasium.make(
        "NicsBridge/Task-v0",
        backend="dds",
        model=ROBOT,
        world="empty",
        task=Thrower,
        backend_options=options,
    )
    env = made.unwrapped
    assert isinstance(env, BridgeEnv)
    return env


def drive(env: BridgeEnv, watcher: Watcher, seed: int) -> None:
    """Drives until the robot moves and a motion is on `cmd_vel`. Raises RuntimeError."""
    env.reset(seed=seed)
    watcher.said.clear()
    deadline_s = time.monotonic() + MOVES_S
    while time.monotonic() < deadline_s:
        if env.step(AHEAD)[2]:
            env.reset()
        if watcher.speed > MOVING and watcher.said and watcher.said[-1][1]:
            return
    raise RuntimeError("the robot does not move, so that nothing can be measured")


def abuse(env: BridgeEnv, watcher: Watcher, rng: Rng) -> tuple[str, list[str]]:
    """Drives, throws, watches; returns what was thrown, and the bars it missed."""
    drive(env, watcher, int(rng.integers(1000)))
    place = pick(rng, PLACES)
    error: BaseException | None = None
    begin_s = time.monotonic()
    try:
        place(env, rng)
    except BaseException as raised:  # noqa: BLE001  (Ctrl-C is among what is thrown)
        error = raised
    Thrower.method = ""
    Thrower.spoil = None
    left_s = time.monotonic()
    time.sleep(WATCH_S)
    sentences = (BridgeError, gymnasium.error.Error)
    missed = {
        "accepted": error is None,
        "tracebacks": place in OF_THE_USER and not isinstance(error, sentences),
        "hangs": left_s - begin_s > HANGS_S,
        "moved": watcher.sees_motion_after(left_s + GRACE_S),
    }
    told = f"{place.__name__} ({type(error).__name__}: {str(error)[:80]})"
    return told, [bar for bar, is_missed in missed.items() if is_missed]


def measure(given: Given) -> Result:
    """Drives and throws so many times; each round takes some seconds."""
    result: Result = dict.fromkeys(BARS, 0) | {"told": []}
    rng = np.random.default_rng(given.seed)
    domain_id = choose_domain_id()
    parameters = {
        "model": ROBOT,
        "world": "empty",
        "mode": "realtime",
        "command_timeout": 3600.0,
        "enable_stamped_cmd_vel": False,
    }
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        simulator = NodeProcess("simulator_node", folder, parameters, domain_id)
        stack.enter_context(simulator)
        watcher = Watcher(domain_id)
        stack.callback(watcher.close)
        if given.control == "no_guard":
            stack.enter_context(mock.patch.object(Link, "halt"))
        env = make_env(domain_id)
        for number in range(given.rounds):
            simulator.check()
            if not env._backend._link._closing.alive:  # a round has closed it
                env = make_env(domain_id)
            told, missed = abuse(env, watcher, rng)
            result["tries"] += 1
            for bar in missed:
                result[bar] += 1
                place = f"seed {given.seed}, round {number}"
                result["told"].append(f"{bar}: {place}, {told}")
        env.close()
    return result


if __name__ == "__main__":
    run_campaign(measure, BARS, {"seed": 0, "rounds": 100})
