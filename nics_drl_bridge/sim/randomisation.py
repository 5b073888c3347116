"""Domain randomisation: robot, sensors and scene of an episode, drawn from ranges in YAML."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, model_validator

from nics_drl_bridge import files
from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.config import Schema, find_config, load_yaml, validate
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.arrays import Array, Integers
from nics_drl_bridge.lidar.faults import SKEW, TOO_CLOSE, Skew, TooClose
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.kernels import make_terms
from nics_drl_bridge.robot.taylor import TaylorModel
from nics_drl_bridge.seeds import check_seeds

Bounds = tuple[Array, Array]
MOST_OBSTACLES = 10_000
# Columns of the noise before those of the state; y drifts as much as x.
NOISE_NAMES = ("odom_linear", "odom_angular", "position_drift", None, "heading_drift")
SCALED = {  # columns scaled by a factor, and the levels that can replace it
    "noise": (slice(0, 2), ("odom_linear", "odom_angular")),
    "drift": (slice(2, None), ("position_drift", "heading_drift")),
}
CORNERS = 256  # Number of combinations of extreme factors checked for stability
FAULT_COLUMNS = (  # see `lidar.fault_kernels`
    "noise_std",
    "noise_proportional",
    "dropout",
    "dropout_far",
    "too_close",
    "quantisation",
    "skew",
)
# faults drawn from a list of options: column, value of each option
CHOICES: dict[str, tuple[int, Mapping[Any, int]]] = {
    "skew": (fault_kernels.SKEW, SKEW),
    "too_close": (fault_kernels.TOO_CLOSE, TOO_CLOSE),
}
KINEMATICS_GROUP, LATENCY_GROUP, ODOMETRY_GROUP, LIDAR_GROUP = range(4)
CHOICES_GROUP, SCENE_GROUP, RESPONSE_GROUP = range(4, 7)
GROUPS = 8
# Larger than the number of columns of a group, so that counters of groups never collide
PLACES = 1 << 20
UNIT = (np.zeros(1), np.ones(1))


def _check_order(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError("a range is [minimum, maximum]")
    return span


NotNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Positive = Annotated[float, Field(ge=1e-3, le=1e3)]
Periods = Annotated[float, Field(ge=0.0, le=50.0)]  # the simulator stores as many
Level = Annotated[tuple[NotNegative, NotNegative], AfterValidator(_check_order)]
Factor = Annotated[tuple[Positive, Positive], AfterValidator(_check_order)]
Latency = Annotated[tuple[Periods, Periods], AfterValidator(_check_order)]
AS_IT_IS: Factor = (1.0, 1.0)


class KinematicRanges(Schema):
    """Factors on the coefficients of the Taylor model, drawn independently."""

    scale: Factor = AS_IT_IS  # for every coefficient
    # one factor per robot on all time constants of the state
    response: Factor = AS_IT_IS
    # overrides `scale`, by name of a rate (`wz`)
    dofs: dict[str, Factor] = Field(default_factory=dict)
    # overrides both, by rate and term: `{wz: {speed*steering: [0.8, 1.2]}}`
    terms: dict[str, dict[str, Factor]] = Field(default_factory=dict)


class OdometryRanges(Schema):
    """Errors of odometry and motion: factors on the model's levels, or levels instead."""

    noise: Factor | None = None  # factor on the noise of the measured twist
    # factor on the measured motion that the model does not explain
    drift: Factor | None = None
    odom_linear: Level | None = None  # noise of velocity [m/s]
    odom_angular: Level | None = None  # noise of yaw rate [rad/s]
    position_drift: Level | None = None  # drift of x and y [m/sqrt(s)]
    heading_drift: Level | None = None  # [rad/sqrt(s)]

    @model_validator(mode="after")
    def _check_once(self) -> "OdometryRanges":
        for factor, (_, levels) in SCALED.items():
            for level in levels:
                if (
                    getattr(self, factor) is not None
                    and getattr(self, level) is not None
                ):
                    raise ValueError(
                        f"give either the factor {factor} or the level {level}"
                    )
        return self


class LidarRanges(Schema):
    """Noise and faults that replace the model's, see `LidarFaults`."""

    noise_std: Level | None = None  # see `LidarSpec` [m]
    noise_proportional: Level | None = None  # added to it for each metre of range [m/m]
    quantisation: Level | None = None  # returns are multiples of it [m]
    dropout: Level | None = None  # probability that a return is lost
    dropout_far: Level | None = None  # added to it at range_max
    # options to draw from, equally likely
    skew: tuple[Skew, ...] | None = Field(default=None, min_length=1)
    # options to draw from, equally likely
    too_close: tuple[TooClose, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _check_probable(self) -> "LidarRanges":
        likely = [name for name in ("dropout", "dropout_far") if getattr(self, name)]
        if sum(getattr(self, name)[1] for name in likely) > 1.0:
            raise ValueError(
                "the maxima of dropout and dropout_far must add up to at most 1"
            )
        return self


class ObstacleRanges(Schema):
    """Number and size of the obstacles of a scene."""

    count: tuple[int, int] | None = None  # [minimum, maximum], instead of the world's
    size: Factor = AS_IT_IS  # factor on the size of every obstacle, one per episode
    # number of sizes, evenly spaced; each is baked
    rungs: int = Field(default=5, ge=2, le=100)

    @model_validator(mode="after")
    def _check_countable(self) -> "ObstacleRanges":
        if self.count and not 0 <= self.count[0] <= self.count[1] <= MOST_OBSTACLES:
            raise ValueError(
                f"count must be [minimum, maximum] from 0 to {MOST_OBSTACLES}"
            )
        return self


class Randomisation(Schema):
    """Ranges to draw from in every episode; the rest is as in model and world."""

    name: str  # used in messages
    # factors on the motion of the model
    kinematics: KinematicRanges = KinematicRanges()
    action_latency: Latency = (0.0, 0.0)  # in addition to the model's [control periods]
    # age of scan and odometry [control periods]
    observation_latency: Latency = (0.0, 0.0)
    odometry: OdometryRanges = OdometryRanges()  # errors of odometry and of motion
    lidar: LidarRanges = LidarRanges()  # noise and faults of the lidar
    obstacles: ObstacleRanges = ObstacleRanges()  # number and size of the obstacles

    @property
    def sizes(self) -> tuple[float, ...]:
        """Possible factors on the obstacles' size, ascending."""
        low, high = self.obstacles.size
        return tuple(
            np.linspace(low, high, self.obstacles.rungs if high > low else 1).tolist()
        )

    def alone(self) -> "dict[str, Randomisation]":
        """Return, by field name, a randomisation of each range that is set."""
        ranges = {name: getattr(self, name) for name in type(self).model_fields}
        names = (name for name in ranges if name in self.model_fields_set - {"name"})
        return {
            name: Randomisation(**{"name": name, name: ranges[name]}) for name in names
        }

    @property
    def fingerprint(self) -> str:
        """Identify the ranges: 16 digits of a SHA-256."""
        return files.hash_bytes(self.model_dump_json().encode())[:16]


def load_randomisation(name: str | Path) -> Randomisation:
    """Load a shipped randomisation by name (`mild`), or any other by the path of its YAML file."""
    return load_yaml(find_config(name, "randomisation"), Randomisation)


# Name of a drawn number (`kinematics.wz.speed*steering`), its field of `Draws`, column if any.
Label = tuple[str, str, int | None]


@dataclass(frozen=True)
class Draws:
    """Numbers of n episodes of M robots: drawn, or else the model's."""

    coefficient: (
        Array  # (n, M, T) of the kept terms, in the order of `robot.kernels.Terms`
    )
    response: Array  # (n, M) factor on time constants, included in `coefficient`
    delay: Integers  # (n, M) latency of commands, including the model's [substeps]
    age: Integers  # (n, M) age of scan and odometry when observed [substeps]
    noise: Array  # (n, M, 2 + 3 + S) see `State.noise`
    faults: Array  # (n, M, P) of each lidar, columns as in `lidar.fault_kernels`
    count: Integers | None  # (n,) obstacles in the scene; None leaves it to the world
    # (n,) index into `Randomisation.sizes`; None if there is only one size
    size: Integers | None
    scale: Array | None  # (n,) factor on the size
    latency: Array  # (n, M, 2) `delay` and `age` in seconds
    # of the drawn numbers that may differ from episode to episode
    labels: tuple[Label, ...]

    def named(self) -> dict[str, NDArray[np.generic]]:
        """Return the drawn numbers by name: (n, M) per robot, (n,) per scene."""
        return {
            name: getattr(self, field)[() if column is None else (..., column)]
            for name, field, column in self.labels
        }


class Sampler:
    """Draws the numbers of episodes.

    A number depends only on seed, robot, group and column, not on the batch.
    """

    def __init__(
        self, randomisation: Randomisation, model: SimulatorModel, robots: int = 1
    ) -> None:
        self.randomisation = randomisation
        self._robots = robots
        where = f"randomisation {randomisation.name!r}"
        self._coefficient = _coefficients(
            randomisation.kinematics, model.kinematics, where
        )
        fastest, slowest = randomisation.kinematics.response
        self._response = np.array([fastest]), np.array([slowest])
        # (T,) terms of the state's
        self._rates = np.nonzero(model.kinematics.coefficients)[0] >= 3
        self._timing = _latencies(randomisation, model)
        self._step = model.timing.dt
        self._noise = _levels(randomisation, model, where)
        self._faults = _faults(randomisation, model.lidar, where)
        self._choices = {}
        for name, (column, values) in CHOICES.items():
            words = getattr(randomisation.lidar, name)
            if words is not None:
                numbers = [values[word] for word in words]
                self._choices[column] = np.array(numbers, np.float64)
        # With these bounds and flooring, all numbers and all sizes are equally likely.
        least, most = randomisation.obstacles.count or (0, 0)
        self._scene = (
            np.array([least, 0.0]),
            np.array([most + 1.0, len(randomisation.sizes)]),
        )
        self._sizes = np.array(randomisation.sizes)
        # Maximum latency of a command and of an observation [substeps].
        self.longest_delay, self.longest_age = (int(most) for most in self._timing[1])
        self._labels = tuple(self._name(model))

    def draw(self, seeds: ArrayLike) -> Draws:
        """Draw the numbers of the episodes of some seeds (n,)."""
        chosen = check_seeds(seeds)
        robots = self._robots
        timing = np.floor(_between(self._timing, chosen, robots, LATENCY_GROUP)).astype(
            np.int64
        )
        scene = np.floor(_between(self._scene, chosen, 1, SCENE_GROUP)[:, 0]).astype(
            np.int64
        )
        noise = _between(self._noise, chosen, robots, ODOMETRY_GROUP)
        noise[..., 3] = noise[..., 2]
        coefficient = _between(self._coefficient, chosen, robots, KINEMATICS_GROUP)
        response = _between(self._response, chosen, robots, RESPONSE_GROUP)
        coefficient[..., self._rates] /= response
        has_sizes = len(self._sizes) > 1
        has_counts = self.randomisation.obstacles.count is not None
        return Draws(
            coefficient,
            response[..., 0],
            timing[..., 0].copy(),
            timing[..., 1].copy(),
            noise,
            self._draw_faults(chosen),
            scene[:, 0] if has_counts else None,
            scene[:, 1] if has_sizes else None,
            self._sizes[scene[:, 1]] if has_sizes else None,
            np.multiply(timing, self._step),
            self._labels,
        )

    def _draw_faults(self, seeds: Integers) -> Array:
        """Draw the faults of the lidars (n, M, P); options of a list are equally likely."""
        faults = _between(self._faults, seeds, self._robots, LIDAR_GROUP)
        for column, values in self._choices.items():
            drawn = _between(UNIT, seeds, self._robots, CHOICES_GROUP, column)[..., 0]
            faults[..., column] = values[(drawn * len(values)).astype(np.int64)]
        return faults

    def _name(self, model: SimulatorModel) -> Iterator[Label]:
        for field, names, (low, high) in (
            ("coefficient", _name_terms(model.kinematics), self._coefficient),
            ("latency", ["action_latency_s", "observation_latency_s"], self._timing),
            ("noise", _name_noise(model), self._noise),
            ("faults", [f"lidar.{fault}" for fault in FAULT_COLUMNS], self._faults),
        ):
            for column, name in enumerate(names):
                is_chosen = field == "faults" and column in self._choices
                if name and (is_chosen or low[column] != high[column]):
                    yield name, field, column
        if self._response[0] != self._response[1]:
            yield "kinematics.response", "response", None
        if self.randomisation.obstacles.count is not None:
            yield "obstacles.count", "count", None
        if len(self._sizes) > 1:
            yield "obstacles.size", "scale", None


def _name_terms(model: TaylorModel) -> list[str]:
    """Return the names of the kept terms, in the order of `robot.kernels.Terms`."""
    kept = zip(*np.nonzero(model.coefficients), strict=True)
    return [f"kinematics.{model.dofs[d]}.{model.term_names[k]}" for d, k in kept]


def _name_noise(model: SimulatorModel) -> list[str | None]:
    """Return the names of the columns of `State.noise`; None for one that is a copy."""
    odometry = [name and f"odometry.{name}" for name in NOISE_NAMES]
    states = [f"odometry.state_drift.{state.name}" for state in model.robot.state]
    return [*odometry, *states]


def _between(
    bounds: Bounds,
    seeds: Integers,
    robots: int,
    group: int,
    column: int = 0,
) -> Array:
    """Draw numbers (n, M, Q) between bounds (Q,), for columns from `column` on."""
    drawn = np.empty((len(seeds), robots, len(bounds[0])))
    first = group * PLACES + column
    stride = GROUPS * PLACES
    stream = random.RANDOMISATION_STREAM
    random.uniform_between(drawn, *bounds, seeds, stream, first, stride)
    return drawn


def _coefficients(ranges: KinematicRanges, model: TaylorModel, where: str) -> Bounds:
    spans = _find_spans(ranges, model, where)
    if ranges.response != AS_IT_IS and not model.state_size:
        raise ConfigError(
            f"{where}: key 'kinematics.response': the model has no state, so it has no time "
            "constants; leave it out."
        )
    spread = spans.copy()
    spread[3:] /= ranges.response[::-1]
    _check_stable(model, spread, where)
    kept = np.nonzero(model.coefficients)
    base = make_terms(model).coefficient
    return base * spans[kept][:, 0], base * spans[kept][:, 1]


def _find_spans(ranges: KinematicRanges, model: TaylorModel, where: str) -> Array:
    """Return the range of the factor on each coefficient, (3 + S, terms, 2)."""
    spans = np.tile(ranges.scale, (*model.coefficients.shape, 1))
    for key, named in (("dofs", ranges.dofs), ("terms", ranges.terms)):
        for dof in named:
            if dof not in model.dofs:
                hint = suggest(dof, model.dofs)
                place = f"{where}: key 'kinematics.{key}'"
                raise ConfigError(f"{place}: unknown rate {dof!r}; {hint}")
    for dof, span in ranges.dofs.items():
        spans[model.dofs.index(dof)] = span
    for dof, terms in ranges.terms.items():
        d = model.dofs.index(dof)
        for term, span in terms.items():
            spans[d, _find_term(term, d, model, where)] = span
    return spans


def _find_term(term: str, d: int, model: TaylorModel, where: str) -> int:
    """Return the number of a term of rate d. Raises ConfigError if the model has none."""
    known = {model.term_names[k]: k for k in np.flatnonzero(model.coefficients[d])}
    name = term
    with suppress(ValueError):
        powers = taylor.parse_term(term, model.variables)
        name = taylor.format_term(powers, model.variables)
    if name in known:
        return int(known[name])
    hint = "the rate has no terms; remove the key."
    if known:
        hint = suggest(term, known)
    raise ConfigError(
        f"{where}: key 'kinematics.terms', rate {model.dofs[d]!r}: the model has no "
        f"term {term!r} there; {hint}"
    )


def _check_stable(model: TaylorModel, spans: Array, where: str) -> None:
    size = model.state_size
    if not size:
        return
    linear = np.zeros((size, size))
    low = np.ones((size, size))
    high = np.ones((size, size))
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
            f"{where}: key 'kinematics': for some factors the state of the robot "
            f"diverges (eigenvalue {worst:.4g} of a step of {model.dt:g} s); narrow "
            "the ranges."
        )


def _latencies(ranges: Randomisation, model: SimulatorModel) -> Bounds:
    """Bounds (2,) of delay and age [substeps]; flooring a draw rounds it."""
    _, substeps, delay = model.timing
    spans = (
        np.array([ranges.action_latency, ranges.observation_latency]) * substeps + 0.5
    )
    spans[0] += delay
    same = np.floor(spans[:, 0]) == np.floor(spans[:, 1])
    spans[same] = np.floor(spans[same])  # equal bounds: nothing is drawn
    return np.ascontiguousarray(spans[:, 0]), np.ascontiguousarray(spans[:, 1])


def _levels(ranges: Randomisation, model: SimulatorModel, where: str) -> Bounds:
    odometry = ranges.odometry
    base = np.array([*model.noise.odometry, *model.noise.simulated_drift(model.robot)])
    low = base.copy()
    high = base.copy()
    for key, (part, names) in SCALED.items():
        factor = getattr(odometry, key)
        if factor is None:
            continue
        if not base[part].any():
            lacks = f"the model of {model.robot.name!r} has no measured {key} to scale"
            raise ConfigError(
                f"{where}: key 'odometry.{key}': {lacks}; give {names[0]!r} "
                f"and {names[1]!r} instead."
            )
        low[part] = base[part] * factor[0]
        high[part] = base[part] * factor[1]
    for column, name in enumerate(NOISE_NAMES):
        level = getattr(odometry, name) if name else None
        if level is not None:
            low[column], high[column] = level
    return low, high


def _faults(ranges: Randomisation, lidar: LidarSpec, where: str) -> Bounds:
    bounds = []
    spans = {
        name: span
        for name, span in ranges.lidar
        if span is not None and name not in CHOICES
    }
    for end in range(2):
        numbers = {name: span[end] for name, span in spans.items()}
        spec = lidar.model_dump() | {
            "noise_std": numbers.pop("noise_std", lidar.noise_std)
        }
        spec["faults"] |= numbers
        bounds.append(validate(spec, LidarSpec, f"{where} of the lidar {lidar.name!r}"))
    return bounds[0].fault_parameters, bounds[1].fault_parameters
