"""Domain randomisation: robot, sensors and scene of an episode, drawn from ranges in YAML."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.config import find_config, load_yaml
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.seeds import checked_seeds
from nics_drl_bridge.sim import randomisation_ranges as bounds
from nics_drl_bridge.sim.randomisation_kernels import (
    KINEMATICS,
    LATENCY,
    LIDAR,
    OBSTACLES,
    ODOMETRY,
    draw_between,
    draw_choice,
    draw_whole,
)
from nics_drl_bridge.sim.randomisation_ranges import Randomisation

__all__ = ["Draws", "Label", "Randomisation", "Sampler", "load_randomisation"]

Array = NDArray[np.float64]
FAULT_COLUMNS = (
    "noise_std", "noise_proportional", "dropout", "dropout_far", "too_close", "quantisation",
    "skew",
)  # fmt: skip
"""Columns of the faults, see `lidar.fault_kernels`."""


def load_randomisation(name: str | Path) -> Randomisation:
    """Loads a shipped randomisation by name (`mild`), or any other by the path of its YAML file."""
    return load_yaml(find_config(name, "randomisation"), Randomisation)


@dataclass(frozen=True)
class Label:
    """Name of a drawn number and its place in `Draws`.

    Attributes:
        name: human-readable: `kinematics.wz.speed*steering`, `action_latency_s`.
        field: of `Draws`.
        column: index along the last axis; None where there is none.
        unit: factor to multiply by, such as seconds per substep.
    """

    name: str
    field: str
    column: int | None = None
    unit: float = 1.0


@dataclass(frozen=True)
class Draws:
    """Draws for n episodes of M robots: every number the simulator needs, drawn or the model's.

    Attributes:
        coefficient: (n, M, T) of the kept terms, in the order of `robot.kernels.term_arrays`.
        delay: (n, M) from a command to its effect, including the model's [substeps].
        age: (n, M) of scan and odometry when they are observed [substeps].
        noise: (n, M, 2 + 3 + S) standard deviations: odometry, linear [m/s] and angular [rad/s],
            and the drift of x, y, heading and state after a second.
        faults: (n, M, P) of each lidar, columns as in `lidar.fault_kernels`.
        count: (n,) obstacles in the scene; None leaves it to the world.
        size: (n,) index into `Randomisation.sizes`; None where there is only one.
        sizes: (R,) the sizes of `Randomisation.sizes`.
        labels: of the drawn numbers that may differ from episode to episode.
    """

    coefficient: Array
    delay: NDArray[np.int64]
    age: NDArray[np.int64]
    noise: Array
    faults: Array
    count: NDArray[np.int64] | None
    size: NDArray[np.int64] | None
    sizes: Array
    labels: tuple[Label, ...]

    def named(self) -> dict[str, NDArray[np.generic]]:
        """Returns the drawn numbers by name: (n, M) per robot, (n,) per scene."""
        named: dict[str, NDArray[np.generic]] = {}
        for label in self.labels:
            value = getattr(self, label.field)
            if label.field == "size":
                value = self.sizes[value]
            elif label.column is not None:
                value = value[..., label.column]
            named[label.name] = value if label.unit == 1.0 else value * label.unit
        return named


class Sampler:
    """Draws the randomised numbers of episodes; a seed is bit-identical in any batch.

    Args:
        randomisation: the ranges.
        model: provides the nominal values.
        robots: M.

    Attributes:
        longest_delay: greatest latency of a command that may occur [substeps].
        longest_age: greatest age of an observation that may occur [substeps].
        skews: True if a lidar may measure its beams one after the other.
    """

    def __init__(
        self, randomisation: Randomisation, model: SimulatorModel, robots: int = 1
    ) -> None:
        self.randomisation = randomisation
        self._robots = robots
        where = f"randomisation {randomisation.name!r}"
        self._coefficient = bounds.coefficients(randomisation.kinematics, model.kinematics, where)
        self._timing, self._step = bounds.latencies(randomisation, model), model.timing[0]
        self._noise = bounds.levels(randomisation, model, where)
        self._faults = bounds.faults(randomisation, model.lidar, where)
        self._choices = tuple(bounds.choices(randomisation))
        self._scene = bounds.scene(randomisation)
        self._sizes = np.array(randomisation.sizes)
        self.longest_delay, self.longest_age = (int(most) for most in self._timing[1])
        skew = [values for column, values in self._choices if column == fault_kernels.SKEW]
        turns = skew[0] if skew else self._faults[0][fault_kernels.SKEW :][:1]
        self.skews = bool(np.any(turns != fault_kernels.AT_ONCE))
        self._labels = tuple(self._name(model))

    def draw(self, seeds: ArrayLike) -> Draws:
        """Draws the numbers of the episodes of some seeds (n,)."""
        chosen = checked_seeds(seeds)
        shape = (len(chosen), self._robots)
        coefficient = np.empty((*shape, len(self._coefficient[0])))
        noise = np.empty((*shape, len(self._noise[0])))
        faults = np.empty((*shape, len(self._faults[0])))
        timing = np.empty((2, *shape), np.int64)
        scene = np.empty((2, len(chosen), 1), np.int64)
        draw_between(coefficient, *self._coefficient, chosen, KINEMATICS)
        draw_between(noise, *self._noise, chosen, ODOMETRY)
        draw_between(faults, *self._faults, chosen, LIDAR)
        draw_whole(timing.transpose(1, 2, 0), *self._timing, chosen, LATENCY)
        draw_whole(scene.transpose(1, 2, 0), *self._scene, chosen, OBSTACLES)
        noise[..., 3] = noise[..., 2]
        for column, values in self._choices:
            draw_choice(faults, column, values, chosen)
        counts = self.randomisation.obstacles.count is not None
        return Draws(
            coefficient, timing[0], timing[1], noise, faults,
            scene[0, :, 0] if counts else None,
            scene[1, :, 0] if len(self._sizes) > 1 else None,
            self._sizes, self._labels,
        )  # fmt: skip

    def _name(self, model: SimulatorModel) -> Iterator[Label]:
        kinematics = model.kinematics
        terms = zip(*np.nonzero(kinematics.coefficients), strict=True)
        for column, (d, k) in enumerate(terms):
            if _varies(self._coefficient, column):
                name = f"kinematics.{kinematics.dofs[d]}.{kinematics.term_names[k]}"
                yield Label(name, "coefficient", column)
        for row, name in enumerate(("action", "observation")):
            if _varies(self._timing, row):
                yield Label(f"{name}_latency_s", ("delay", "age")[row], None, self._step)
        states = tuple(f"state_drift.{variable.name}" for variable in model.robot.state)
        for column, noise in enumerate((*bounds.NOISE_NAMES, *states)):
            if noise and _varies(self._noise, column):
                yield Label(f"odometry.{noise}", "noise", column)
        chosen = [column for column, _ in self._choices]
        for column, fault in enumerate(FAULT_COLUMNS):
            if column in chosen or _varies(self._faults, column):
                yield Label(f"lidar.{fault}", "faults", column)
        if self.randomisation.obstacles.count is not None:
            yield Label("obstacles.count", "count")
        if len(self._sizes) > 1:
            yield Label("obstacles.size", "size")


def _varies(ends: bounds.Bounds, column: int) -> bool:
    return bool(ends[0][column] != ends[1][column])
