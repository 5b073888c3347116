"""Drive: a recording of a robot, what stages derive from it, and kinds of sentences on it."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Settings
from nics_drl_bridge.identify.statistics import (
    DIFFERENCE_GAIN,
    DIFFERENCE_ORDER,
    GAUSSIAN_MAD,
)
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import RobotSpec

MIN_STAMPS = 20
# in bursts, the mean interval exceeds this many times the 30th percentile
BURSTY = 5.0
# stamps closer than this fraction of the period belong to one burst
WITHIN_BURST = 0.25
UNEVEN = 0.5
# minimum fraction of gap-free stretches for which only those are used
LEAST_WHOLE = 0.1
NEGLIGIBLE = 1e-6  # m, rad
REST_SAMPLES = 12
REST_DRIFT = 3.0  # standard errors at rest; straight motion shows at least 4
SLOPE_NOISE = 0.05
MAX_SPAN_S = 0.2
MAX_GAP_S = 0.25


@dataclass(frozen=True, eq=False)
class Drive:
    """A recording of a robot, or a part of one; derived properties are computed on first use."""

    recording: Recording
    spec: RobotSpec
    settings: Settings = field(default_factory=Settings)

    def part(self, recording: Recording) -> "Drive":
        """Returns a drive of the same robot with other streams."""
        if recording is self.recording:
            return self
        return replace(self, recording=recording)

    def under(self, settings: Settings) -> "Drive":
        """Returns the same drive, with its cached properties, under other options."""
        same = replace(self, settings=settings)
        vars(same).update(vars(self) | {"settings": settings})
        return same

    def folds(self, count: int) -> "Iterator[tuple[Drive, Drive]]":
        """Yields the drive without the poses of a block, and with these alone, block by block."""
        pose = self.recording.pose
        for block in np.array_split(np.arange(len(pose.t)), count):
            others = np.ones(len(pose.t), dtype=np.bool_)
            others[block] = False
            yield (
                self.part(replace(self.recording, pose=pose.rows(others))),
                self.part(replace(self.recording, pose=pose.rows(block))),
            )

    @property
    def duration_s(self) -> float:
        """Time from the first pose to the last [s]."""
        return float(self.recording.pose.t[-1] - self.recording.pose.t[0])

    @cached_property
    def bursts(self) -> "Bursts | None":
        """Bursts of the poses; None if they arrive one by one."""
        return find_bursts(self.recording.without_gaps(self.recording.pose.t))

    @cached_property
    def sample_t(self) -> Array:
        """Estimated sample times (T,) of the poses, on their clock [s]."""
        return spread(self.recording.pose.t, self.bursts)

    @cached_property
    def dated(self) -> Stream:
        """Poses whose sample time is best known: the newest of each burst, or all."""
        return self.recording.pose.rows(
            slice(None) if self.bursts is None else self.bursts.newest
        )

    def trust(self, start: Array, end: Array) -> Array:
        """Returns weights (..., 3) of motions from start to end on the pose's clock, usually 1."""
        means = []
        for variance in 1.0 / self.recording.pose.weights.T:
            at_start = np.interp(start, self.sample_t, variance)
            at_end = np.interp(end, self.sample_t, variance)
            means.append((at_start + at_end) / 2.0)
        return np.asarray(1.0 / np.stack(means, axis=-1))

    @cached_property
    def pose_noise(self) -> tuple[float, float] | None:
        """Standard deviations of position [m] and heading [rad]; None if they can't be measured."""
        return measure_pose_noise(self.recording.pose, self.bursts)

    @cached_property
    def twists(self) -> "TwistIntervals":
        """Twists of the tracked body over spans long enough for motion to stand out from noise."""
        if self.bursts is not None:
            stride = 1
            longest = 1.8 * self.bursts.period_s
        else:
            stride = self._find_stride()
            longest = MAX_GAP_S
        t = self.dated.t[::stride]
        pose = self.dated.values[::stride]
        span = np.diff(t)
        usable = (span > 0.0) & (span < max(longest, 3.0 * float(np.median(span))))
        moved = geometry.log(geometry.between(pose[:-1], pose[1:])[usable])
        twist = moved / span[usable, None]
        return TwistIntervals(t[:-1][usable], t[1:][usable], twist)

    def _find_stride(self) -> int:
        """Returns the number of steps of the pose over which motion stands out from its noise."""
        t = self.dated.t
        pose = self.dated.values
        dt = float(np.median(np.diff(t)))
        longest = max(1, round(MAX_SPAN_S / dt))
        moved = geometry.between(pose[:-longest:longest], pose[longest::longest])
        twist = geometry.log(moved) / (longest * dt)
        if not len(twist):
            twist = np.zeros((1, 3))
        speed = float(np.sqrt((twist[:, :2] ** 2).sum(axis=1).mean()))
        turn = float(np.sqrt((twist[:, 2] ** 2).mean()))
        position_noise, heading_noise = self.pose_noise or (0.0, 0.0)
        needed_s = np.sqrt(2.0) * max(
            position_noise / max(SLOPE_NOISE * speed, 1e-9),
            heading_noise / max(SLOPE_NOISE * turn, 1e-9),
        )
        return int(np.clip(np.ceil(needed_s / dt), 1, longest))


@dataclass(frozen=True)
class Bursts:
    """Samples that a driver delivers together and that therefore share one time of arrival."""

    period_s: float  # usual time between two bursts
    size: float  # usual number of samples per burst
    of: NDArray[np.intp]  # (T,) burst of each sample
    # (K,) last sample of each burst, the most recent on arrival
    newest: NDArray[np.intp]


def unwrap_headings(pose: Array) -> Array:
    """Returns poses (T, 3) with unwrapped headings."""
    return np.concatenate([pose[:, :2], np.unwrap(pose[:, 2])[:, None]], axis=1)


def find_bursts(t: Array) -> Bursts | None:
    """Finds bursts in stamps (T,) [s]; None if the samples arrive one by one."""
    if len(t) < MIN_STAMPS:
        return None
    gaps = np.diff(t)
    if gaps.mean() <= BURSTY * np.percentile(gaps, 30):
        return None
    period = float(np.median(gaps[gaps > gaps.mean()]))
    starts = np.concatenate([[True], gaps > WITHIN_BURST * period])
    of = np.cumsum(starts) - 1
    newest = np.append(np.flatnonzero(starts)[1:] - 1, len(t) - 1)
    return Bursts(period, float(np.median(np.bincount(of))), of, newest)


def spread(t: Array, bursts: Bursts | None) -> Array:
    """Estimates sample times (T,) from arrivals (T,) [s], spreading each burst evenly."""
    if bursts is None:
        return t
    count = np.bincount(bursts.of)
    arrival = t[np.concatenate([[0], bursts.newest[:-1] + 1])]
    since = np.diff(arrival, prepend=arrival[0] - bursts.period_s)
    span = np.minimum(since, bursts.period_s * np.maximum(1.0, count / bursts.size))
    behind = bursts.newest[bursts.of] - np.arange(len(t))
    return np.asarray(arrival[bursts.of] - span[bursts.of] * behind / count[bursts.of])


def measure_pose_noise(
    pose: Stream, bursts: Bursts | None
) -> tuple[float, float] | None:
    """Returns standard deviations of position [m] and heading [rad] of poses, if measurable."""
    # Measured by sixth differences, in which smooth motion vanishes; for bursts, whose sample times
    # are too uncertain for that, by stretches at rest.
    if bursts is not None:
        sigma = _spread_at_rest(unwrap_headings(pose.values))
    else:
        rest = measure_pose_residual(pose)
        if len(rest) >= DIFFERENCE_ORDER:
            sigma = np.median(np.abs(rest), axis=0) / GAUSSIAN_MAD
        else:
            sigma = None
    if sigma is None:
        return None
    sigma = np.where(sigma < NEGLIGIBLE, 0.0, sigma)
    return float(np.hypot(sigma[0], sigma[1]) / np.sqrt(2.0)), float(sigma[2])


def measure_pose_residual(pose: Stream) -> Array:
    """Returns sixth differences (n, 3) at the scale of the noise, over gap-free stretches."""
    rest = np.asarray(
        np.diff(unwrap_headings(pose.values), DIFFERENCE_ORDER, axis=0)
        / DIFFERENCE_GAIN
    )
    if not len(rest):
        return rest
    span = np.diff(pose.t)
    even = np.abs(span - np.median(span)) < UNEVEN * np.median(span)
    whole = (
        np.convolve(even, np.ones(DIFFERENCE_ORDER), "valid") > DIFFERENCE_ORDER - 0.5
    )
    return np.asarray(rest[whole]) if whole.mean() > LEAST_WHOLE else rest


def _spread_at_rest(pose: Array) -> Array | None:
    """Returns the spread (3,) in stretches whose halves agree; None if there are too few."""
    count = len(pose) // REST_SAMPLES
    blocks = pose[: count * REST_SAMPLES].reshape(count, REST_SAMPLES, 3)
    spread = blocks.std(axis=1, ddof=1)
    half = REST_SAMPLES // 2
    drift = np.abs(blocks[:, :half].mean(axis=1) - blocks[:, half:].mean(axis=1))
    still = (drift < REST_DRIFT * spread / np.sqrt(half)).all(axis=1)
    still &= (spread < 10.0 * np.maximum(spread.min(axis=0), NEGLIGIBLE)).all(axis=1)
    if still.sum() < 2:
        return None
    return np.asarray(np.sqrt((spread[still] ** 2).mean(axis=0)))


@dataclass(frozen=True)
class TwistIntervals:
    """Twists of the tracked body, in its frame, over intervals on the pose's clock [s]."""

    start: Array  # (n,)
    end: Array  # (n,)
    twist: Array  # (n, 3) constant twist whose arc joins the poses at both ends

    def on_clock(self, offset: float) -> tuple[Array, Array]:
        """Returns start and end on a clock that is ahead of the pose's by an offset."""
        return self.start + offset, self.end + offset


class Gap(str):
    """A sentence on something that a drive could not teach."""


class Doubt(str):
    """A sentence on something that looks wrong, but may be how the robot behaves."""


class Alone(str):
    """A sentence on a single recording with large errors."""


class Mistake(str):
    """A sentence on a wrong mapping; the model is only valid with that mapping."""
