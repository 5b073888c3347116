"""Recording: separately stamped streams of a drive; Samples: all on one time axis (Sec. IV-A)."""

import io
import json
import zipfile
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import files, geometry
from nics_drl_bridge.arguments import format_value
from nics_drl_bridge.config import check_no_device
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.heading import Turning
from nics_drl_bridge.recording.mapping import UNITS
from nics_drl_bridge.robot.noise import Latency
from nics_drl_bridge.robot.spec import RobotSpec

FORMAT = "nics_drl_bridge/recording/4"
STREAMS = ("command", "pose", "state", "wheels", "imu", "odometry")
MeasuredBy = Literal["", "odometry", "tracker", "truth"]
"""What measured a pose: odometry, which drifts; motion capture or a localiser; a simulation."""
# A step that differs from the median by this fraction counts as a gap or a repetition.
IRREGULAR = 0.5
# Steps that differ by less count as equally long, except for rounding.
JITTER = 1e-4
ROUNDING_S = 1e-6

LARGEST_TURN = 1.5  # a larger turn between neighbouring samples is implausible [rad]
TOO_FAST = 20.0  # a speed above this multiple of the maximum command is implausible
SPEED_OVER_S = 0.5
SLOWEST_SAMPLING_S = 2.0
# Accelerations that no wheeled robot exceeds for a quarter of the time [m/s^2]: one with a radius
# below 1 m; and any robot, with the downforce of race cars
HARDEST = 14.0
HARDEST_OF_CARS = 60.0
SMALL_M = 1.0
# Speed above which millimetres are more likely than centimetres [m/s]
SLOWEST_IN_CM = 300.0
FASTEST_TURN = 15.0  # a heading that turns faster for long is in degrees [rad/s]
FULL_TURN_DEG = 360.0
# Minimum alignment of a path with a heading in degrees, and margins by which it exceeds the
# alignment with the same heading in radians and with a fixed one
ALONG = 0.9
LESS_ALONG = 0.2
ALONG_BY_CHANCE = 0.05
# Minimum number of pieces, and turn [rad], of a path that shows a reversed axis
MIN_DIRECTIONS = 30
MIN_TURN = 1.0
# Minimum alignment of the path with mirrored headings, and its margin over unmirrored ones
MIN_MIRRORED = 0.9
BETTER = 0.15
# Quaternions w, x, y, z of a level body, read as x, y, z, w: the mean squares of x and y add up to
# more than TILTED, those of y and z to less than LEVEL.
TILTED = 0.05
LEVEL = 0.01
W_FIRST = "its quaternions look like w, x, y, z of a level body; list them in the order x, y, z, w"
WEIGHTS = 0.01, 100.0  # bounds on weights by variance
UNITS_OF_STEP = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


@dataclass(frozen=True)
class Stream:
    """Values with stamps of a named clock; two clocks differ by an unknown offset."""

    t: Array  # (T,) stamps [s], never decreasing
    values: Array  # (T, D)
    clock: str = "robot"
    # (T, D) standard deviations of the values, where they are known
    sigma: Array | None = None

    @property
    def weights(self) -> Array:
        """Weights (T, D) by inverse variance: 1 for the median deviation, or if it is unknown."""
        weights = np.ones_like(self.values)
        if self.sigma is None:
            return weights
        is_known = np.isfinite(self.sigma) & (self.sigma > 0.0)
        for column, sigma, rows in zip(
            weights.T, self.sigma.T, is_known.T, strict=True
        ):
            if rows.any():
                relative = sigma[rows] / np.median(sigma[rows])
                column[rows] = np.clip(relative**-2.0, *WEIGHTS)
        return weights

    def rows(self, keep: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Stream":
        """Returns the rows selected by a mask (T,), indices or a slice."""
        sigma = self.sigma
        if sigma is not None:
            sigma = sigma[keep]
        return replace(self, t=self.t[keep], values=self.values[keep], sigma=sigma)


@dataclass(frozen=True)
class Episode:
    """A part of a recording that does not continue the previous part, as after a reset."""

    source: str  # the recording that it comes from, for the report
    # time of the first pose, and of the last, on the clock that pose and commands share [s]
    start_s: float
    end_s: float

    @property
    def duration_s(self) -> float:
        """Duration [s]."""
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Recording:
    """A drive of a robot, or several, as episodes on one time axis with gaps between them."""

    command: Stream  # (T, C) in the order of the RobotSpec
    pose: Stream  # (T, 3) x [m], y [m], heading [rad] of the tracked body, in a fixed frame
    state: Stream | None = None  # (T, S) measured, in the order of the RobotSpec
    # (T, 2) left and right wheel speed in the encoder's units
    wheels: Stream | None = None
    # (T, 3) acceleration along x, y [m/s^2], yaw rate [rad/s]
    imu: Stream | None = None
    # (T, 3) vx, vy [m/s], yaw rate [rad/s] by the wheels
    odometry: Stream | None = None
    source: str = "recording"  # its origin, for reports and errors
    # names of X = [state, command] of the recorded robot, if known
    variables: tuple[str, ...] = ()
    # the robot's definition as in its YAML file, if a mapping gives it
    robot: dict[str, Any] | None = None
    # measured latency of scan and odometry, if known
    latency: Latency = field(default_factory=Latency)
    # a sentence on each repair made while reading, such as of clocks
    repairs: tuple[str, ...] = ()
    measured_by: MeasuredBy = ""  # what measured the pose; empty if unknown
    # comparison of the turns by odometry and gyro, if the gyro gives or confirms the
    # heading
    gyro: Turning | None = None
    episodes: tuple[Episode, ...] = ()  # in order; empty for a single drive
    # end of the training episodes, which come first [s after the first pose]; None if
    # there are no episodes, or if the fit chooses
    learn_until_s: float | None = None

    def episode_at(self, t: ArrayLike) -> NDArray[np.intp]:
        """Returns the index of the episode of each time (...) [s].

        A gap between two episodes is split in the middle.
        """
        ends = np.array([episode.end_s for episode in self.episodes[:-1]])
        starts = np.array([episode.start_s for episode in self.episodes[1:]])
        return np.asarray(np.searchsorted((ends + starts) / 2.0, t))

    def without_gaps(self, t: Array) -> Array:
        """Returns times (T,) [s] with gaps between episodes replaced by the usual step."""
        if not self.episodes or len(t) < 2:
            return t
        step = np.diff(t)
        is_gap = np.diff(self.episode_at(t)) > 0
        step[is_gap] = np.median(step[~is_gap]) if not is_gap.all() else 0.0
        return np.asarray(t[0] + geometry.accumulate(step))

    def driven_s(self, until_s: float = np.inf) -> float:
        """Returns the driving time until a time after the first pose [s], without gaps.

        An episode counts in full if it begins before that time.
        """
        first = float(self.pose.t[0])
        if not self.episodes:
            return float(min(self.pose.t[-1] - first, until_s))
        return sum(e.duration_s for e in self.episodes if e.start_s - first <= until_s)

    @property
    def streams(self) -> dict[str, Stream]:
        """Available streams, by name."""
        named = ((name, getattr(self, name)) for name in STREAMS)
        return {name: stream for name, stream in named if stream is not None}


@dataclass(frozen=True)
class Samples:
    """The paper's data: one row per time step."""

    t: Array  # (T,) start of each step [s]
    q: Array  # (T, 3 + S) pose of `base_link` and state at the start of the step
    x: Array  # (T, S + C) X = [state, command] during the step
    # (T, 3 + S) dQ/dt: the constant body twist whose exact arc leads from this pose to the next
    # (`geometry.log`), and the mean rate of the state.
    dq: Array
    dt: float  # length of a step [s]

    def rows(self, keep: NDArray[np.bool_]) -> "Samples":
        """Returns the samples of the steps for which `keep` (T,) is true."""
        return Samples(self.t[keep], self.q[keep], self.x[keep], self.dq[keep], self.dt)


def samples_on_one_clock(
    t: Array, pose: Array, state: Array, command: Array
) -> Samples:
    """Builds Samples from shared stamps [s]: a row per regular step, no gaps or repetitions."""
    span = np.diff(t)
    dt = compute_usual_step(t)
    is_regular = np.abs(span - dt) < IRREGULAR * dt
    is_exact = np.abs(span - dt) < JITTER * dt + ROUNDING_S
    length = np.where(is_exact, dt, span)[is_regular, None]
    first = np.flatnonzero(is_regular)
    last = first + 1
    twist = geometry.log(geometry.between(pose[first], pose[last])) / length
    rates = (state[last] - state[first]) / length
    return Samples(
        t=t[first],
        q=np.concatenate([pose, state], axis=1)[first],
        x=np.concatenate([state, command], axis=1)[first],
        dq=np.concatenate([twist, rates], axis=1),
        dt=dt,
    )


def check(recording: Recording, spec: RobotSpec) -> Recording:
    """Returns a recording that fits a robot. Raises RecordingError with place and fault if not."""
    for word, value, kind, source in (
        ("recording", recording, Recording, "a Recording, as read_recording(path)"),
        ("robot", spec, RobotSpec, "a RobotSpec, as load_robot(name)"),
    ):
        if not isinstance(value, kind):
            raise ConfigError(
                f"{word}={format_value(value)}: must be {source} returns."
            )
    names = spec.variable_names
    recorded = recording.variables
    if recording.state is None:  # then only the order of the commands matters
        count = len(spec.command)
        names = names[-count:]
        recorded = recorded[-count:]
    if recorded and recorded != names:
        raise RecordingError(
            f"{recording.source}: is a drive of a robot with "
            f"{', '.join(recording.variables)}; the robot {spec.name!r} has "
            f"{', '.join(spec.variable_names)}: choose the recorded robot."
        )
    check_streams(
        recording, {"command": len(spec.command), "state": len(spec.state), "wheels": 2}
    )
    speeds = [max(-v.min, v.max) for v in spec.command if v.unit == "m/s"]
    fastest = max(speeds, default=np.inf)
    pose = recording.pose
    radius = spec.footprint_radius
    fault = find_implausible_pose(pose.t, pose.values, fastest, radius)
    if fault:
        raise RecordingError(
            f"{recording.source}: pose: {fault.reason}; {fault.cause}."
        )
    return recording


def check_streams(recording: Recording, width: dict[str, int]) -> None:
    """Refuses streams without `width` (by default 3) columns, with NaN, or out of order."""
    for name, stream in recording.streams.items():
        fault = _find_fault(stream, width.get(name, 3))
        if fault:
            raise RecordingError(f"{recording.source}: {name}: {fault}.")


def _find_fault(stream: Stream, width: int) -> str:
    t = stream.t
    values = stream.values
    if values.shape != (len(t), width):
        return (
            f"has the shape {values.shape} where ({len(t)}, {width}) is needed; check "
            "that this robot was recorded"
        )
    if len(t) < 2:
        return f"has {len(t)} samples; record a drive of 20 s or more"
    if t[-1] == t[0]:
        return f"all of its stamps are {t[0]:g} s; choose another column as its time"
    is_finite = np.isfinite(values).all(axis=1) & np.isfinite(t)
    if not is_finite.all():
        return (
            f"row {int(np.argmin(is_finite))} holds NaN or inf; remove the row, or "
            "find out why it was recorded"
        )
    backward = np.flatnonzero(np.diff(t) < 0.0)
    if len(backward):
        before, after = t[backward[0] : backward[0] + 2]
        return (
            f"time runs backwards at row {backward[0] + 1} ({before:.6f} s, then "
            f"{after:.6f} s); sort the rows, or cut the file there"
        )
    return ""


def save_recording(recording: Recording, path: str | Path) -> None:
    """Writes `.npz`: `NAME_t`, `NAME`, `NAME_sigma` per stream, JSON `meta`; adds a checksum."""
    streams = recording.streams
    arrays: dict[str, NDArray[Any]] = {}
    for name, stream in streams.items():
        arrays[f"{name}_t"], arrays[name] = stream.t, stream.values
        if stream.sigma is not None:
            arrays[f"{name}_sigma"] = stream.sigma
    meta = {
        "format": FORMAT,
        "source": recording.source,
        "clocks": {name: stream.clock for name, stream in streams.items()},
        "variables": recording.variables,
        "repairs": recording.repairs,
        "measured_by": recording.measured_by,
        "robot": recording.robot,
        "episodes": [asdict(episode) for episode in recording.episodes],
        "learn_until_s": recording.learn_until_s,
        "latency": recording.latency.model_dump(mode="json"),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, meta=np.array(json.dumps(meta)), **arrays)  # type: ignore[arg-type]
    files.write_bytes(path, files.seal(buffer.getvalue()))


def load_recording(path: str | Path) -> Recording:
    """Reads a file of `save_recording`. Raises RecordingError if it is missing or damaged."""
    try:
        data = files.read_file(check_no_device(Path(path)))
        arrays = _read_arrays(data)
        meta = json.loads(str(arrays["meta"]))
        version = meta["format"]
        if version != FORMAT:
            raise RecordingError(
                f"{path}: format {version!r} is not {FORMAT!r}; record it again or use "
                "the version of the package that wrote it."
            )
        files.check_sealed(io.BytesIO(data))
        streams: Any = {}
        for name, clock in meta["clocks"].items():
            sigma = arrays.get(f"{name}_sigma")
            if sigma is not None:
                sigma = sigma.astype(float)
            t = arrays[f"{name}_t"].astype(float)
            streams[name] = Stream(t, arrays[name].astype(float), clock, sigma)
        measured_by = meta.get("measured_by", "")
        if measured_by not in get_args(MeasuredBy):
            raise ValueError(f"measured_by is {measured_by!r}")
        return Recording(
            **streams,
            source=str(path),
            variables=tuple(meta["variables"]),
            repairs=tuple(meta["repairs"]),
            robot=meta.get("robot"),
            latency=Latency.model_validate(meta.get("latency", {})),
            measured_by=measured_by,
            episodes=tuple(Episode(**fields) for fields in meta.get("episodes", ())),
            learn_until_s=meta.get("learn_until_s"),
        )
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file; check the path.") from None
    except (AttributeError, KeyError, RecursionError, TypeError) as error:
        raise RecordingError(
            f"{path}: is not a recording of this package ({error}); describe its "
            "content with --map, or write it with save_recording."
        ) from None
    except (ValueError, OSError) as error:
        raise RecordingError(
            f"{path}: can't be read as .npz ({error}); it may be damaged."
        ) from None


def is_recording(path: Path) -> bool:
    """True for a file that `save_recording` wrote."""
    if not path.is_file():  # reading a pipe might never end
        return False
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return "meta" in arrays.files and "pose_t" in arrays.files
    except Exception:  # noqa: BLE001 - any other file breaks numpy in any way
        return False


def _read_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """Returns the arrays of an `.npz` file. Raises ValueError if it is damaged or too large."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise ValueError("it is not a zip archive")
    try:
        if files.count_unpacked(io.BytesIO(data)) > files.MOST_BYTES:
            raise ValueError(
                f"unpacked it is larger than {files.MOST_BYTES // 2**20} MB"
            )
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # noqa: BLE001 - damage breaks zipfile and numpy in any way
        raise ValueError(str(error) or type(error).__name__) from None


class Implausible(NamedTuple):
    """A fault of poses and its explanation."""

    reason: str
    cause: str
    line: str  # for the mapping, such as `heading_unit: deg`


def find_implausible_pose(
    t: Array, pose: Array, fastest: float = np.inf, radius: float = 0.0
) -> Implausible | None:
    """Finds poses (T, 3) at t (T,) [s] that degrees, centimetres or milliseconds explain.

    `fastest` is the maximum commanded speed [m/s], inf if it is unknown; `radius` [m] is the
    robot's.
    """
    if len(t) < 3:
        return None
    unit = guess_time_unit(t)
    if unit is not None:
        reason = f"there are {np.median(np.diff(t)):.3g} s between samples"
        cause = f"stamps must be in seconds ({UNITS_OF_STEP[unit]} look like this)"
        return Implausible(reason, cause, f"time: {{from: ..., unit: {unit}}}")
    degrees = _find_degrees(t, pose)
    if degrees is not None:
        return degrees
    spaced = _select_spaced(t)
    pose = pose[spaced]
    if _is_only_along(pose, 180.0 / np.pi):
        largest = f"the heading is up to {np.abs(pose[:, 2]).max():.2g} rad"
        reason = f"{largest}, and the path follows 57 times that angle"
        cause = "it was in radians, but is read as degrees"
        return Implausible(reason, cause, "heading_unit: rad")
    hardest = HARDEST if radius < SMALL_M else HARDEST_OF_CARS
    return _find_too_fast(t[spaced], pose, fastest, hardest)


def _find_degrees(t: Array, pose: Array) -> Implausible | None:
    heading = pose[:, 2]
    largest = np.abs(heading).max()
    step = np.diff(heading)
    turn = np.percentile(np.abs(geometry.wrap_angle(step)), 95)
    reason = f"the heading is up to {largest:.4g} rad"
    if turn > LARGEST_TURN:
        reason = f"the heading jumps by {turn:.1f} rad between neighbouring samples"
    elif largest <= 2.0 * np.pi + 0.1:
        return None
    else:
        wraps = np.abs(np.abs(step) - FULL_TURN_DEG) < FULL_TURN_DEG / 10.0
        spaced = _select_spaced(t)
        turned = np.diff(np.unwrap(heading, period=FULL_TURN_DEG)[spaced])
        rate = np.abs(turned) / np.diff(t[spaced])
        is_fast = len(rate) > 0 and np.percentile(rate, 90) > FASTEST_TURN
        if not (wraps.any() or is_fast or _is_only_along(pose[spaced], np.pi / 180.0)):
            return None
    cause = "it must be in radians (degrees look like this)"
    return Implausible(reason, cause, "heading_unit: deg")


def _is_only_along(pose: Array, scale: float) -> bool:
    """True if the path of poses (T, 3) follows headings x scale, but not the unscaled ones."""
    scaled = _measure_alignment(pose, scale)
    unscaled = _measure_alignment(pose, 1.0)
    fixed = _measure_alignment(pose, 0.0)
    return scaled > max(ALONG, unscaled + LESS_ALONG, fixed + ALONG_BY_CHANCE)


def select_along_path(pose: Array, apart: float) -> NDArray[np.intp]:
    """Returns the indices of poses (of (T, 3)) that are about `apart` [m] on their path."""
    path = geometry.measure_path(pose)
    return np.unique(np.searchsorted(path, np.arange(0.0, path[-1], apart)))


def has_visible_axes(pose: Array) -> bool:
    """True if poses (T, 3), spaced on their path, turn far enough to show a reversed axis."""
    if len(pose) < MIN_DIRECTIONS:
        return False
    return float(np.ptp(np.unwrap(pose[:, 2]))) >= MIN_TURN


class HeadingKeys(str, Enum):
    """Keys of a mapping that correct a heading."""

    __str__ = str.__str__

    NONE = ""
    MIRRORED = "scale: -1"  # counted clockwise
    COMPASS = f"scale: -1, offset: {np.pi / 2.0:.5g}"  # clockwise from north


def find_clockwise_keys(pose: Array) -> HeadingKeys:
    """Returns the mapping's keys that mirror the heading of poses (T, 3), spaced on their path.

    None are needed unless the path is aligned with the mirrored headings by at least
    `MIN_MIRRORED`, and by `BETTER` more than with the recorded ones.
    """
    least = max(MIN_MIRRORED, BETTER + _measure_alignment(pose, 1.0))
    if not has_visible_axes(pose) or _measure_alignment(pose, -1.0) < least:
        return HeadingKeys.NONE
    return choose_clockwise_keys(pose)


def choose_clockwise_keys(pose: Array) -> HeadingKeys:
    """Returns the keys that mirror the heading of poses (T, 3) so that it is along the path."""
    is_ahead = _compute_course(pose, -1.0).real > 0.0
    return HeadingKeys.MIRRORED if is_ahead else HeadingKeys.COMPASS


def _measure_alignment(pose: Array, scale: float) -> float:
    """Returns the alignment, 0 to 1, of the path of poses (T, 3) with headings x scale, or back."""
    return abs(_compute_course(pose, scale))


def _compute_course(pose: Array, scale: float) -> complex:
    """Returns the mean of exp(2i x direction of travel), relative to the headings x scale."""
    x, y = np.diff(pose[:, :2], axis=0).T
    ahead = np.exp(1j * scale * pose[:, 2])
    middle = ahead[1:] + ahead[:-1]  # its angle lies between the two headings
    middle = middle / np.maximum(np.abs(middle), 1e-9)
    step = np.hypot(x, y)
    course = (x + 1j * y) / np.maximum(step, 1e-9)
    return complex((step * (course / middle) ** 2).sum() / max(step.sum(), 1e-9))


def _select_spaced(t: Array) -> NDArray[np.intp]:
    """Returns the indices of samples that are about half a second apart."""
    return np.unique(np.floor((t - t[0]) / SPEED_OVER_S), return_index=True)[1]


def _find_too_fast(
    t: Array, pose: Array, fastest: float, hardest: float
) -> Implausible | None:
    """Finds spaced poses (T, 3) that move too fast, or change their speed too fast."""
    span = np.maximum(np.diff(t), 1e-9)
    if not len(span):
        return None
    velocity = np.diff(pose[:, :2], axis=0) / span[:, None]
    speed = np.percentile(np.hypot(*velocity.T), 90)
    reason = f"moves at {speed:.3g} m/s"
    if speed > TOO_FAST * fastest:
        reason += f", but its commands are at most {fastest:g} m/s"
    elif np.isfinite(fastest) or len(span) < 3:
        return None
    else:
        change = np.hypot(*np.diff(velocity, axis=0).T) / span[1:]
        acceleration = np.percentile(change, 75)
        if acceleration <= hardest:
            return None
        reason += f" and changes that by {acceleration:.3g} m/s^2"
    cause = "positions must be in metres and stamps in seconds"
    unit = "mm" if speed > SLOWEST_IN_CM else "cm"
    return Implausible(reason, cause, f"unit: {unit}")


def compute_usual_step(t: Array) -> float:
    """Returns the median of the steps forward between stamps (T,), 0 if there are none."""
    step = np.diff(t)
    forward = step[step > 0.0]
    return float(np.median(forward)) if len(forward) else 0.0


def guess_time_unit(t: Array) -> str | None:
    """Returns the unit of stamps (T,) that can't be seconds; None if they can."""
    step = compute_usual_step(t)
    for unit in ("s", *UNITS_OF_STEP):
        if step * UNITS[unit].factor <= SLOWEST_SAMPLING_S:
            return None if unit == "s" else unit
    return None


def is_w_first(quaternions: ArrayLike) -> bool:
    """True if quaternions (T, 4), read as x, y, z, w, look like w, x, y, z of a level body."""
    size = np.mean(np.square(np.asarray(quaternions).reshape(-1, 4)), axis=0)
    return bool(size[0] + size[1] > TILTED and size[1] + size[2] < LEVEL)


def compute_heading(x: Array, y: Array, z: Array, w: Array) -> Array:
    """Returns the headings (T,) of quaternions [rad]."""
    return np.asarray(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
