"""What the ranges of domain randomisation come to for one model: bounds of every drawn number."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kinematics import features
from nics_drl_bridge.kinematics.kernels import term_arrays
from nics_drl_bridge.kinematics.model import TaylorModel
from nics_drl_bridge.lidar import fault_kernels
from nics_drl_bridge.lidar.faults import SKEW, TOO_CLOSE
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.sim.randomisation_ranges import Factor, KinematicRanges, Randomisation

Array = NDArray[np.float64]
Bounds = tuple[Array, Array]
NOISE_NAMES = ("odom_linear", "odom_angular", "position_drift", None, "heading_drift")
"""Columns of the noise, before those of the state; the drift of y is that of x."""
CORNERS = 256
"""So many mixtures of least and greatest factors are looked at for whether they are stable."""


def coefficients(ranges: KinematicRanges, model: TaylorModel, where: str) -> Bounds:
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


def latencies(ranges: Randomisation, model: SimulatorModel) -> Bounds:
    """Bounds (2,) of delay and age, such that cutting down the draws rounds them [substeps]."""
    _, substeps, delay = model.timing
    spans = np.array([ranges.action_latency, ranges.observation_latency]) * substeps + 0.5
    spans[0] += delay
    same = np.floor(spans[:, 0]) == np.floor(spans[:, 1])
    spans[same] = np.floor(spans[same])  # so that nothing is drawn
    return np.ascontiguousarray(spans[:, 0]), np.ascontiguousarray(spans[:, 1])


def levels(ranges: Randomisation, model: SimulatorModel, where: str) -> Bounds:
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


def faults(ranges: Randomisation, lidar: LidarSpec, where: str) -> Bounds:
    """Bounds (P,) of the lidar's noise and faults."""
    bounds = []
    for end in range(2):
        std = lidar.noise_std if ranges.lidar.noise_std is None else ranges.lidar.noise_std[end]
        numbers = ranges.lidar.numbers(end)
        faults = lidar.faults.model_dump() | numbers
        spec = lidar.model_dump() | {"noise_std": std, "faults": faults}
        bounds.append(validate(spec, LidarSpec, f"{where} of the lidar {lidar.name!r}"))
    return bounds[0].fault_parameters, bounds[1].fault_parameters


def choices(ranges: Randomisation) -> Iterator[tuple[int, Array]]:
    """Columns of the faults whose value is one of some, and these values."""
    if ranges.lidar.skew is not None:
        values = [SKEW[word] for word in ranges.lidar.skew]
        yield fault_kernels.SKEW, np.array(values, dtype=np.float64)
    if ranges.lidar.too_close is not None:
        values = [TOO_CLOSE[word] for word in ranges.lidar.too_close]
        yield fault_kernels.TOO_CLOSE, np.array(values, dtype=np.float64)


def scene(ranges: Randomisation) -> Bounds:
    """Bounds (2,) of number and size index, such that cutting down makes each as likely."""
    least, most = ranges.obstacles.count or (0, 0)
    return np.array([least, 0.0]), np.array([most + 1.0, len(ranges.sizes)])
