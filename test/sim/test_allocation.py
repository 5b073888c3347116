from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys
from robots import circles, field, noisy_model

from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

STEPS = 50
STRETCHES = 20
WARM_UP = 20
BOOKKEEPING = 20_000
"""Python's own objects that a step makes and drops, whatever the number of worlds [bytes]."""
GROWTH = 1250
"""What a stretch of steps may leave behind [bytes]: less than an object for each."""
FEW = 2
"""Times that compiled code allocates per step: the handle of the commands that it is given."""
WALKERS = {**circles(3), "motion": {"kind": "pedestrian", "speed": [0.2, 0.5]}}
SCENES = {
    "many obstacles that stand": (field(12.0, 40), 1, 160),
    "robots and obstacles that move on a map": (
        World.model_validate(
            {
                "name": "room",
                "map": "room",
                "clearance": 0.1,
                "goal_distance": [0.5, 9.0],
                "obstacles": [circles(3), WALKERS],
            }
        ),
        4,
        40,
    ),
}
"""World, robots, and so many worlds that a copy of their scans would be seen."""


def taken(step):
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
    gc.freeze()  # a collection then looks only at what the steps made
    tracemalloc.start()
    try:
        step()
        for _ in range(STRETCHES):
            gc.collect()
            begin = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            for _ in range(STEPS):
                step()
            most.append(tracemalloc.get_traced_memory()[1] - begin)
            gc.collect()
            grown.append(tracemalloc.get_traced_memory()[0] - begin)
            if grown[-1] < GROWTH and min(most) < BOOKKEEPING:
                break
    finally:
        tracemalloc.stop()
        gc.unfreeze()
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
def test_a_simulator_allocates_nothing_per_step_however_many_worlds_it_has(scene):
    world, robots, worlds = SCENES[scene]
    model = noisy_model()
    simulator = FastSimulator(model, world, worlds, robots)
    simulator.reset(range(worlds))
    slow = 0.3 * model.robot.command_high  # so that few robots are in contact
    commands = np.random.default_rng(0).uniform(-slow, slow, (worlds, robots, 3))
    grown, most = taken(lambda: simulator.step(commands))
    assert compiled(lambda: simulator.step(commands)) < FEW
    assert grown < GROWTH
    assert most < BOOKKEEPING
    assert simulator.data.ranges.nbytes > 2 * BOOKKEEPING
