from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys
from robots import circles, direct_model, field, lidar

from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

STEPS = 100
STRETCHES = 20
WARM_UP = 20
BOOKKEEPING = 20_000
"""Python's own objects that a step makes and drops, whatever the number of worlds [bytes]."""
GROWTH = 2500
"""What a stretch of steps may leave behind [bytes]: less than an object for each."""
FEW = 2
"""Times that compiled code allocates per step: the handle of the commands that it is given."""
MOVING = {**circles(3), "motion": {"kind": "pedestrian", "speed": [0.2, 0.5]}}
SCENES = {
    "circles": (lambda: field(6.0, 5), 1, 160),
    "map": (lambda: load_world("room"), 1, 160),
    "moving obstacles": (lambda: field(6.0, obstacles=[MOVING]), 1, 160),
    "several robots": (lambda: field(10.0, 5), 8, 20),
}
"""World, robots, and so many worlds that a copy of their scans would be seen."""


def noisy_model():
    return direct_model(
        latency=0.03, odometry=(0.05, 0.03), sensor=lidar(noise_std=0.01)
    )


def taken(step, steps=STEPS, bookkeeping=BOOKKEEPING):
    """Bytes that some steps leave behind, and the most that they take meanwhile.

    numpy tells tracemalloc of its arrays; numba counts those of compiled code, see `compiled`.
    Python and numba fill their free lists and caches once, at a time of their own: of some
    stretches of steps the one that leaves the least behind counts, and the first that leaves
    nothing is enough. What is lost with every step is lost in each of them.
    """
    for _ in range(WARM_UP):
        step()
    grown = []
    most = []
    tracemalloc.start()
    try:
        step()
        for _ in range(STRETCHES):
            gc.collect()
            begin = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            for _ in range(steps):
                step()
            most.append(tracemalloc.get_traced_memory()[1] - begin)
            gc.collect()
            grown.append(tracemalloc.get_traced_memory()[0] - begin)
            if grown[-1] < GROWTH and min(most) < bookkeeping:
                break
    finally:
        tracemalloc.stop()
    return min(grown), min(most)


def compiled(step, steps=10):
    """How often compiled code allocates in a step."""
    _nrt_python.memsys_enable_stats()
    try:
        step()
        begin = rtsys.get_allocation_stats().alloc
        for _ in range(steps):
            step()
        return (rtsys.get_allocation_stats().alloc - begin) / steps
    finally:
        _nrt_python.memsys_disable_stats()


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(
    "several",
    [
        pytest.param(False, marks=pytest.mark.campaign, id="one"),
        pytest.param(True, id="many"),
    ],
)
def test_a_simulator_allocates_nothing_per_step_however_many_worlds_it_has(
    scene, several
):
    world, robots, worlds = SCENES[scene]
    worlds = worlds if several else 1
    model = noisy_model()
    simulator = FastSimulator(model, world(), worlds, robots)
    simulator.reset(range(worlds))
    low = model.robot.command_low
    high = model.robot.command_high
    commands = np.random.default_rng(0).uniform(low, high, (worlds, robots, len(low)))
    grown, most = taken(lambda: simulator.step(commands))
    assert compiled(lambda: simulator.step(commands)) < FEW
    assert grown < GROWTH
    assert most < BOOKKEEPING
    if several:
        assert simulator.data.ranges.nbytes > 2 * BOOKKEEPING
