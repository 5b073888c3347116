"""How long calls take on a machine that does other things at the same time."""

import time
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from typing import TypeVar

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.kernels import SERIES, make_terms, run, simulate_rollouts
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

WARM_UP = 3
ROUNDS = 5
ROBOTS = 1024
HOLDS = 20
HOLD_S = 0.1  # for which a robot of many keeps a command
SINGLE_STEPS = 50_000
Name = TypeVar("Name", bound=Hashable)


def interleaved(
    calls: Mapping[Name, Callable[[], object]],
    repeats: int,
    warm: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Name, list[float]]:
    """Times of each call [s], all in turn, so that a slow moment slows all of them.

    With `warm`, each is called once more just before, so that what it reads is in the caches. With
    `time.process_time` as the `clock`, other work on the machine does not count, all threads do.
    """
    for _ in range(WARM_UP):
        for call in calls.values():
            call()
    times: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            if warm:
                call()
            begin = clock()
            call()
            times[name].append(clock() - begin)
    return times


def slowed(call: Callable[[], object], control: str | None) -> Callable[[], object]:
    """Returns a call that under the control `slow` is made ten times."""
    if control != "slow":
        return call
    return lambda: [call() for _ in range(10)]


def medians(times: Mapping[Name, list[float]]) -> dict[Name, float]:
    """The median time of each call [s]."""
    return {name: float(np.median(each)) for name, each in times.items()}


def shortest(times: Mapping[Name, list[float]]) -> dict[Name, float]:
    """The shortest time of each call [s]: what others do on the machine only ever adds."""
    return {name: min(each) for name, each in times.items()}


def measure_speeds(
    model: TaylorModel,
    spec: RobotSpec,
    others: Mapping[str, tuple[Callable[[], object], float]],
) -> dict[str, float]:
    """Returns simulated seconds per second: `batched`, `single`, and of other calls, all in turn.

    Args:
        model: whose robots are driven by random commands: many at once, and one alone.
        spec: of the robot.
        others: a call by its name, and how much time it simulates [s].
    """
    rng = np.random.default_rng(7)
    low = spec.command_low
    high = spec.command_high
    many = rng.uniform(low[:, None], high[:, None], (HOLDS, len(low), ROBOTS))
    alone = rng.uniform(low, high, (1, SINGLE_STEPS, len(low)))
    batched, ends = make_batched(model, many, round(HOLD_S / model.dt))
    single, poses = make_single(model, alone)
    timed = {
        "batched": (batched, ROBOTS * HOLDS * HOLD_S),
        "single": (single, SINGLE_STEPS * model.dt),
        **others,
    }
    calls = {name: call for name, (call, _) in timed.items()}
    seconds = shortest(interleaved(calls, ROUNDS))
    if not (np.isfinite(ends).all() and np.isfinite(poses).all()):
        seconds |= dict.fromkeys(("batched", "single"), np.nan)  # fast and worthless
    return {name: lasted / seconds[name] for name, (_, lasted) in timed.items()}


def make_batched(
    model: TaylorModel, commands: Array, steps: int
) -> tuple[Callable[[], object], Array]:
    """Returns a call that drives N robots by commands (H, C, N) of some steps, and their poses."""
    count = commands.shape[2]
    terms = make_terms(model)
    each = np.repeat(terms.coefficient[:, None], count, axis=1)
    terms = terms._replace(coefficient=each)
    x = np.zeros((len(model.variables) + 1, count))
    dq = np.zeros((len(model.dofs), count))
    pose = np.zeros((6, count))

    def drive() -> None:
        for array in (x, dq, pose):
            array[:] = 0.0
        x[-1] = pose[2] = 1.0
        for command in commands:
            x[model.state_size : -1] = command
            run(pose, x, dq, terms, SERIES, model.dt, steps)

    return drive, pose


def make_single(
    model: TaylorModel, commands: Array
) -> tuple[Callable[[], object], Array]:
    """Returns a call that drives a robot by commands (1, T, C), a step each, and its poses."""
    steps = commands.shape[1] + 1
    poses = np.zeros((1, steps, 3))
    states = np.zeros((1, steps, model.state_size))
    terms = make_terms(model)
    return partial(
        simulate_rollouts, poses, states, commands, terms, SERIES, model.dt
    ), poses
