"""Worlds come to the same bits in any batch, part and thread, crowded or not."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from robots import direct_model, field, lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim import allocation as sizes
from nics_drl_bridge.sim.simulator import FastSimulator

STEPS = 500


def model():
    return direct_model(latency=0.03, odometry=(0.05, 0.03), sensor=lidar(noise_std=0.01))


def vary(simulator, seed=0):
    """Gives each world parameters of its own; world i the same in a batch of any size."""
    data = simulator.data
    for n in range(len(data.steps)):
        rng = np.random.default_rng([seed, n])
        data.coefficient[n] *= rng.uniform(0.8, 1.2, data.coefficient[n].shape)
        data.delay[n] = rng.integers(0, 25, data.delay[n].shape)
        data.age[n] = rng.integers(0, 25, data.age[n].shape)
        data.noise[n, :, 2:] = 0.02
        data.velocity[n] = rng.uniform(-0.3, 0.3, data.velocity[n].shape)
        data.faults[n, :, -1] = rng.integers(-1, 2)


def digests(worlds, threads=1, robots=2, steps=STEPS, parts=False):
    """SHA-256 of all that each world came to in a drive."""
    simulator = FastSimulator(
        model(), field(4.0, count=3), worlds, robots, threads=threads, longest_delay=25,
        longest_age=25,
    )  # fmt: skip
    vary(simulator)
    simulator.reset(range(worlds))
    found = [hashlib.sha256() for _ in range(worlds)]
    generators = [np.random.default_rng(n) for n in range(worlds)]
    for _ in range(steps):
        command = np.array([rng.uniform(-1.0, 1.0, (robots, 3)) for rng in generators])
        if parts:
            for part in reversed(simulator.parts):
                simulator.step_part(part, command[part])
        else:
            simulator.step(command)
        for n in range(worlds):
            for array in simulator.data:
                found[n].update(array[n].tobytes())
    assert simulator.data.collided.sum() > 0
    return [digest.hexdigest() for digest in found]


@pytest.fixture(scope="module")
def expected():
    return digests(64)


def test_two_threads_come_to_the_bits_of_one(expected):
    assert digests(64, threads=2) == expected


@pytest.mark.parametrize("worlds", [1, 4, 16])
def test_a_world_comes_to_the_same_bits_in_a_batch_of_any_size(expected, worlds):
    assert digests(worlds) == expected[:worlds]


def test_parts_stepped_by_themselves_come_to_the_same_bits(expected):
    assert digests(16, threads=3, parts=True) == expected[:16]


def test_a_crowd_in_cells_comes_to_the_bits_of_looking_at_all_bodies(monkeypatch):
    plain = digests(2, robots=12, steps=60)
    monkeypatch.setattr(sizes, "CROWD", 0)
    assert sizes.Sizes(1, 12, 3, 0, 0).crowded
    assert digests(2, robots=12, steps=60) == plain
    monkeypatch.setattr(sizes, "SCATTERED", 0)
    assert sizes.Sizes(1, 12, 3, 0, 0).scattered
    assert digests(2, robots=12, steps=60) == plain


def test_the_parts_are_all_worlds_in_order():
    for worlds, threads in ((1, 1), (5, 2), (7, 3), (2, 8)):
        parts = FastSimulator(model(), field(), worlds, threads=threads).parts
        assert len(parts) == min(worlds, threads)
        assert [n for part in parts for n in range(part.start, part.stop)] == list(range(worlds))


def test_what_runs_in_parts_comes_back_in_their_order():
    simulator = FastSimulator(model(), field(), 5, threads=2)
    assert simulator.run_parts(lambda part: part.start) == [0, 2]


def test_commands_of_another_shape_are_refused():
    simulator = FastSimulator(model(), field(), 3)
    with pytest.raises(ConfigError, match=r"must be \(3, 1, 3\)"):
        simulator.step(np.zeros((1, 1, 3)))
    with pytest.raises(ConfigError, match=r"must be \(3, 1, 3\)"):
        simulator.step_part(simulator.parts[0], np.zeros((2, 1, 3)))


@pytest.mark.parametrize("changes", [{"threads": 0}, {"longest_delay": 2}, {"longest_age": -1}])
def test_a_simulator_without_threads_or_room_is_refused(changes):
    with pytest.raises(ConfigError, match="at least 1 thread"):
        FastSimulator(model(), field(), 3, **changes)
