"""How long calls take on a machine that does other things at the same time."""

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import numpy as np

WARM_UP = 3
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
