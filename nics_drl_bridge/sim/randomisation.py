"""Domain randomisation: which robot, sensors and scene an episode gets, within YAML's ranges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.config import find_config, load_yaml, validate
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kinematics import features
from nics_drl_bridge.kinematics.kernels import term_arrays
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import SKEW, TOO_CLOSE
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.sim import randomisation_kernels as kernels
from nics_drl_bridge.sim.randomisation_ranges import Factor, KinematicRanges, Randomisation

__all__ = ["Draws", "Label", "Randomisation", "Sampler", "load_randomisation"]

Array = NDArray[np.float64]
Bounds = tuple[Array, Array]
NOISE_NAMES = ("odom_linear", "odom_angular", "position_drift", None, "heading_drift")
"""Columns of the noise, before those of the state; the drift of y is that of x."""
FAULT_COLUMNS = (
    "noise_std", "noise_proportional", "dropout", "dropout_far", "too_close", "quantisation",
    "skew",
)  # fmt: skip
"""Columns of the faults, see `lidar.fault_kernels`."""
CORNERS = 256
"""So many mixtures of least and greatest factors are looked at for whether they are stable."""


def load_randomisation(name: str) -> Randomisation:
    """Loads a shipped randomisation by name (`mild`), or any by the path of its YAML file."""
    return load_yaml(find_config(name, "randomisation"), Randomisation)


@dataclass(frozen=True)
class Label:
    """A drawn number's name, and where it stands in `Draws`.

    Attributes:
        name: for people: `kinematics.wz.speed*steering`, `action_latency_s`.
        field: of `Draws`.
        column: along the last axis; None where there is none.
        unit: what to multiply by, such as seconds per substep.
    """

    name: str
    field: str
    column: int | None = None
    unit: float = 1.0


@dataclass(frozen=True)
class Draws:
    """What n episodes of M robots got: every number the simulator needs, drawn or the model's.

    Attributes:
        coefficient: (n, M, T) of the kept terms, in the order of `kinematics.kernels.term_arrays`.
        delay: (n, M) from a command to its effect, the model's included [substeps].
        age: (n, M) of scan and odometry when they are seen [substeps].
        noise: (n, M, 2 + 3 + S) standard deviations: odometry, linear [m/s] and angular [rad/s],
            and the drift of x, y, heading and state after a second.
        faults: (n, M, P) of each lidar, columns as in `lidar.fault_kernels`.
        count: (n,) obstacles in the scene; None leaves it to the world.
        size: (n,) index into `Randomisation.sizes`; None where there is only one.
        sizes: (R,) those of `Randomisation.sizes`.
        labels: of what was drawn and may differ from episode to episode.
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
        """What was drawn, by name: (n, M) of each robot, (n,) of the scene."""
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
    """Draws what episodes get; a seed gives the same bits in a batch of any size.

    Args:
        randomisation: the ranges.
        model: what they are ranges around.
        robots: M.

    Attributes:
        longest_delay: greatest latency of a command that may occur [substeps].
        longest_age: greatest age of an observation that may occur [substeps].
        skews: whether a lidar may measure its beams one after the other.
    """

    def __init__(
        self, randomisation: Randomisation, model: SimulatorModel, robots: int = 1
    ) -> None:
        self.randomisation = randomisation
        self._robots = robots
        where = f"randomisation {randomisation.name!r}"
        self._coefficient = _coefficients(randomisation.kinematics, model.kinematics, where)
        self._timing, self._step = _latencies(randomisation, model), model.timing[0]
        self._noise = _levels(randomisation, model, where)
        self._faults = _faults(randomisation, model.lidar, where)
        self._choices = tuple(_choices(randomisation))
        self._scene = _scene(randomisation)
        self._sizes = np.array(randomisation.sizes)
        self.longest_delay, self.longest_age = (int(most) for most in self._timing[1])
        skew = [values for column, values in self._choices if column == fault_kernels.SKEW]
        turns = skew[0] if skew else self._faults[0][fault_kernels.SKEW :][:1]
        self.skews = bool(np.any(turns != fault_kernels.AT_ONCE))
        self._labels = tuple(self._name(model))

    def draw(self, seeds: ArrayLike) -> Draws:
        """What the episodes of some seeds (n,) get."""
        chosen = np.asarray(seeds, dtype=np.int64)
        shape = (len(chosen), self._robots)
        coefficient = np.empty((*shape, len(self._coefficient[0])))
        noise = np.empty((*shape, len(self._noise[0])))
        faults = np.empty((*shape, len(self._faults[0])))
        timing = np.empty((2, *shape), np.int64)
        scene = np.empty((2, len(chosen), 1), np.int64)
        kernels.draw_between(coefficient, *self._coefficient, chosen, kernels.KINEMATICS)
        kernels.draw_between(noise, *self._noise, chosen, kernels.ODOMETRY)
        kernels.draw_between(faults, *self._faults, chosen, kernels.LIDAR)
        kernels.draw_whole(timing.transpose(1, 2, 0), *self._timing, chosen, kernels.LATENCY)
        kernels.draw_whole(scene.transpose(1, 2, 0), *self._scene, chosen, kernels.OBSTACLES)
        noise[..., 3] = noise[..., 2]
        for column, values in self._choices:
            kernels.draw_choice(faults, column, values, chosen)
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
        for column, noise in enumerate((*NOISE_NAMES, *states)):
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


def _varies(bounds: Bounds, column: int) -> bool:
    return bool(bounds[0][column] != bounds[1][column])


def _coefficients(ranges: KinematicRanges, model: TaylorModel, where: str) -> Bounds:
    """Bounds (T,) of the coefficients. Raises ConfigError for a name or a range that is wrong."""
    spans = np.tile(ranges.scale, (*model.coefficients.shape, 1))
    for dof, span in ranges.dofs.items():
        spans[_rate(dof, model, f"{where}: key 'kinematics.dofs'")] = span
    for dof, terms in ranges.terms.items():
        place = f"{where}: key 'kinematics.terms'"
        d = _rate(dof, model, place)
        for term, span in terms.items():
            spans[d, _term(d, term, model, f"{place}, rate {dof!r}")] = span
    _check_stable(model, spans, where)
    kept = np.nonzero(model.coefficients)
    base = term_arrays(model)[1]
    return base * spans[kept][:, 0], base * spans[kept][:, 1]


def _rate(name: str, model: TaylorModel, where: str) -> int:
    if name not in model.dofs:
        raise ConfigError(f"{where}: unknown rate {name!r}; {nearest(name, model.dofs)}")
    return model.dofs.index(name)


def _term(d: int, name: str, model: TaylorModel, where: str) -> int:
    kept = np.flatnonzero(model.coefficients[d])
    try:
        row = features.parse_term(name, model.variables)
    except ValueError:
        row = None
    for k in kept:
        if row is not None and np.array_equal(model.powers[k], row):
            return int(k)
    known = [model.term_names[k] for k in kept]
    raise ConfigError(
        f"{where}: the model has no term {name!r} there; "
        + (nearest(name, known) if known else "it has none at all: remove it.")
    )


def _check_stable(model: TaylorModel, spans: Array, where: str) -> None:
    """Raises ConfigError when a state that dies out would grow for some factors.

    Looks at the linear part of the state's step, of which no eigenvalue may pass 1.
    """
    size = model.state_size
    if not size:
        return
    linear = np.zeros((size, size))
    low, high = np.ones_like(linear), np.ones_like(linear)
    for k in np.flatnonzero(model.powers.sum(axis=1) == 1):
        v = int(np.argmax(model.powers[k]))
        if v < size:
            linear[:, v] = model.coefficients[3:, k]
            low[:, v], high[:, v] = spans[3:, k].T
    mixed = np.random.default_rng(0).integers(0, 2, (CORNERS, size, size)).astype(bool)
    steps = np.eye(size) + model.dt * linear * np.where(mixed, low, high)
    nominal = np.abs(np.linalg.eigvals(np.eye(size) + model.dt * linear)).max()
    worst = np.abs(np.linalg.eigvals(steps)).max()
    if worst > max(1.0, nominal) + 1e-9:
        raise ConfigError(
            f"{where}: key 'kinematics': with some of these factors the state of the robot grows "
            f"by itself (eigenvalue {worst:.4g} of a step of {model.dt:g} s); narrow the ranges."
        )


def _latencies(ranges: Randomisation, model: SimulatorModel) -> Bounds:
    """Bounds (2,) of delay and age, such that cutting down the draws rounds them [substeps]."""
    _, substeps, delay = model.timing
    spans = np.array([ranges.action_latency, ranges.observation_latency]) * substeps + 0.5
    spans[0] += delay
    same = np.floor(spans[:, 0]) == np.floor(spans[:, 1])
    spans[same] = np.floor(spans[same])  # so that nothing is drawn
    return np.ascontiguousarray(spans[:, 0]), np.ascontiguousarray(spans[:, 1])


def _levels(ranges: Randomisation, model: SimulatorModel, where: str) -> Bounds:
    """Bounds (2 + 3 + S,) of the noise."""
    odometry = ranges.odometry
    base = np.array([*model.noise.odometry, *model.noise.simulated_drift(model.robot)])
    factors: tuple[tuple[str, Factor | None, slice, str], ...] = (
        ("noise", odometry.noise, slice(0, 2), "'odom_linear' and 'odom_angular'"),
        ("drift", odometry.drift, slice(2, None), "'position_drift' and 'heading_drift'"),
    )
    low, high = base.copy(), base.copy()
    for key, factor, part, instead in factors:
        if factor is None:
            continue
        if not base[part].any():
            raise ConfigError(
                f"{where}: key 'odometry.{key}': the model of {model.robot.name!r} has no "
                f"measured {key} to scale; give {instead} instead."
            )
        low[part], high[part] = base[part] * factor[0], base[part] * factor[1]
    for column, name in enumerate(NOISE_NAMES):
        level = getattr(odometry, name) if name else None
        if level is not None:
            low[column], high[column] = level
    return low, high


def _faults(ranges: Randomisation, lidar: LidarSpec, where: str) -> Bounds:
    """Bounds (P,) of the lidar's noise and faults."""
    bounds = []
    for end in range(2):
        std = lidar.noise_std if ranges.lidar.noise_std is None else ranges.lidar.noise_std[end]
        numbers = ranges.lidar.numbers(end)
        faults = lidar.faults.model_dump() | numbers
        spec = lidar.model_dump() | {"noise_std": std, "faults": faults}
        bounds.append(validate(spec, LidarSpec, f"{where} of the lidar {lidar.name!r}"))
    return bounds[0].fault_parameters, bounds[1].fault_parameters


def _choices(ranges: Randomisation) -> Iterator[tuple[int, Array]]:
    """Columns of the faults whose value is one of some, and these values."""
    if ranges.lidar.skew is not None:
        values = [SKEW[word] for word in ranges.lidar.skew]
        yield fault_kernels.SKEW, np.array(values, dtype=np.float64)
    if ranges.lidar.too_close is not None:
        values = [TOO_CLOSE[word] for word in ranges.lidar.too_close]
        yield fault_kernels.TOO_CLOSE, np.array(values, dtype=np.float64)


def _scene(ranges: Randomisation) -> Bounds:
    """Bounds (2,) of number and size index, such that cutting down makes each as likely."""
    least, most = ranges.obstacles.count or (0, 0)
    return np.array([least, 0.0]), np.array([most + 1.0, len(ranges.sizes)])
