"""Mounting: position and rotation of the tracked body on the robot."""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # its parts load slowly, when used
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array, rotate, wrap_angle
from nics_drl_bridge.identify import clocks
from nics_drl_bridge.identify.alignment import (
    average_held,
    find_speed_index,
    has_motion_as_state,
    list_followed_commands,
)
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive, TwistIntervals
from nics_drl_bridge.identify.statistics import (
    CERTAIN,
    estimate_clustered_errors,
    estimate_standard_errors,
)
from nics_drl_bridge.identify.terms import has_slipping_tyres, list_reversed_variables
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.kernels import MAX_ORDER
from nics_drl_bridge.robot.kinds import (
    compute_steady_twist,
    has_textbook,
    slips,
    textbook,
)
from nics_drl_bridge.robot.spec import RobotSpec

TURN_SCALE_M = 0.2  # weight of a yaw rate: the speed at this distance
DISTINCT = 4.0  # minimum ratio of the second direction of motion to the noise
MIN_SECOND = 0.05  # minimum ratio of its size to that of the first
STILL = 1e-3
# fraction of all turning below which turning the other way does not count
ONE_WAY = 0.05
# a smaller in-plane part of the direction without extent means that the body never turned
FLAT = 0.02
MIN_LENGTH = 1e-4  # m, rad
BLOCKS = 8
STRONG = 10.0  # instruments with a smaller F are weak (Staiger, Stock 1997)
SAME = 1e-6  # minimum part of an instrument that differs from the others
RIDGE = 1e-12  # regularisation, relative to the noise, for a drive without any


@dataclass(frozen=True)
class Mounting:
    """Rotation and lever arm, as in `Calibration`, with standard uncertainty."""

    rotation: float  # heading of `base_link` minus that of the tracked body [rad]
    lever: Array  # (2,) position of the tracked point in `base_link` [m]
    rotation_sigma: float  # [rad]
    lever_sigma: Array  # (2,) [m]; NaN for a component that could not be learnt
    ways: int  # number of directions in which the robot turned: 2 for left and right
    slip: bool = False  # True if the lever arm can't be distinguished from slip

    @property
    def hidden(self) -> tuple[str, str]:
        """Reasons why the lever arm along x, and y, could not be learnt; empty where it was."""
        known_x, known_y = ~np.isnan(self.lever_sigma)
        along = "" if known_y else "no speed was known apart from the tracked one"
        if known_x:
            return "", along
        ways = (
            "the robot never turned",
            "all of the path had one curvature",
            "noise hides it",
        )
        why = "slip looks alike" if self.slip and self.ways else ways[self.ways]
        return why, why


def estimate_mounting(drive: Drive, timing: clocks.TimingEstimate) -> Mounting | None:
    """Estimates the mounting; None if the drive does not show it."""
    spec = drive.spec
    twists = drive.twists
    if not (has_textbook(spec) or spec.takes_cmd_vel):
        return None  # its forward direction is unknown
    if spec.moves_sideways:
        return _estimate_by_commands(drive, timing)
    start, end = twists.on_clock(timing.offset)
    command = average_held(
        drive.recording.command, spec, start - timing.latency, end - timing.latency
    )
    forward = _predict_twists(spec, command)[:, 0]
    _, noise = drive.pose_noise or (0.0, 0.0)
    mounting = estimate_mounting_without_lateral_motion(twists, forward, noise)
    if mounting is None:
        return None
    if not spec.state or has_motion_as_state(spec, drive.recording):
        if has_slipping_tyres(spec) or slips(spec):
            return estimate_mounting_with_slip(twists, mounting, spec)
        return mounting
    states = clocks.average_expected_states(drive, twists, timing)
    if drive.recording.state is None or np.isnan(mounting.lever_sigma[0]):
        mounting = (
            estimate_mounting_by_instruments(twists, states, forward, spec) or mounting
        )
    place = find_speed_index(spec)
    if place is not None and np.isnan(mounting.lever_sigma).tolist() == [False, True]:
        mounting.lever[1], mounting.lever_sigma[1] = estimate_lateral_lever(
            twists, mounting.rotation, states[:, place]
        )
    return mounting


def estimate_mounting_by_instruments(
    motion: TwistIntervals, states: Array, forward: Array, spec: RobotSpec
) -> Mounting | None:
    """Estimates the mounting by instruments from the states (n, S); None if these are too weak."""
    powers = taylor.list_exponents(states.shape[1], MAX_ORDER)
    chi = taylor.evaluate(
        states / np.maximum(np.abs(states).max(axis=0), STILL), powers
    )
    basis = scipy.linalg.orth(chi, rcond=SAME)
    seen = basis @ (basis.T @ motion.twist)
    normal = _find_still_direction(motion.twist, seen, basis.shape[1])
    if normal is None:
        return None
    if float(motion.twist[:, :2] @ [normal[1], -normal[0]] @ forward) < 0.0:
        normal = -normal
    travel = float(np.arctan2(-normal[0], normal[1]))
    ahead = rotate(seen[:, :2], -travel)[:, :1]
    sigma = estimate_standard_errors(
        np.hstack([ahead, seen[:, 2:]]), motion.twist @ normal
    )
    if CERTAIN * sigma[1] > spec.footprint_radius:
        return None
    odd = list_reversed_variables(spec) or ()
    aside = powers[:, [v.name in odd for v in spec.state]].sum(axis=1) % 2 == 1
    across = 0.0, np.nan
    if aside.any():  # motion along x is even in what a mirror reverses
        even = np.hstack([scipy.linalg.orth(chi[:, ~aside], rcond=SAME), seen[:, 2:]])
        across = _estimate_lever_by_mirror(motion, travel, even)
    lever, lever_sigma = np.transpose([(-normal[2], sigma[1]), across])
    return Mounting(travel, lever, float(sigma[0]), lever_sigma, 2)


def _find_still_direction(twist: Array, seen: Array, size: int) -> Array | None:
    """Returns the direction (3,) in which twists (n, 3) have no extent, by `size` instruments.

    `seen` (n, 3) is what the instruments explain of them. None if the instruments are too weak.
    """
    # The states are independent of the twists' noise, and what they do along x they do not do along
    # y: limited-information maximum likelihood (Anderson, Rubin 1949).
    noise = (twist - seen).T @ (twist - seen)
    power = seen.T @ seen
    noise += RIDGE * np.trace(power + noise) * np.eye(3)
    strength, axes = scipy.linalg.eigh(power, noise)
    flat = float(np.hypot(*axes[:2, 0]) / np.linalg.norm(axes[:, 0]))
    if not strength[1] * (len(twist) - size) / size > STRONG or flat < FLAT:
        return None
    return np.asarray(axes[:, 0] / np.hypot(*axes[:2, 0]))


def _estimate_lever_by_mirror(
    motion: TwistIntervals, travel: float, even: Array
) -> tuple[float, float]:
    """Returns the lever arm along y and its error from features (n, K), the last the turn rate."""
    along = rotate(motion.twist[:, :2], -travel)[:, 0]
    beta = np.linalg.lstsq(even, along, rcond=None)[0]
    rest = along - even[:, :-1] @ beta[:-1] - beta[-1] * motion.twist[:, 2]
    return -float(beta[-1]), float(estimate_standard_errors(even, rest)[-1])


def estimate_mounting_with_slip(
    motion: TwistIntervals, plain: Mounting, spec: RobotSpec
) -> Mounting:
    """Estimates the mounting on a robot that may slip sideways when it turns.

    A car's tyres yield in proportion to the lateral force: a slip of speed^2 x turn rate
    (Gillespie). Skidding is opposite in reverse; without reversing it looks like a lever arm.
    """
    along = rotate(motion.twist[:, :2], -plain.rotation)
    speed = along[:, 0]
    turn = motion.twist[:, 2]
    skids = slips(spec)
    slip = speed * turn if skids else (along**2).sum(axis=1) * turn
    chi = np.stack([speed, turn, slip], axis=1)
    beta = np.linalg.lstsq(chi, along[:, 1], rcond=None)[0]
    sigma = estimate_standard_errors(chi, along[:, 1] - chi @ beta)
    hidden = skids and _count_ways(speed * np.abs(turn)) < 2
    if hidden or not CERTAIN * sigma[1] < spec.footprint_radius:
        return replace(
            plain, lever=np.zeros(2), lever_sigma=np.full(2, np.nan), slip=True
        )
    if abs(beta[2]) < CERTAIN * sigma[2]:
        return plain
    rotation = plain.rotation + float(np.arctan(beta[0]))
    lever = np.array([float(beta[1]), 0.0])
    return Mounting(
        rotation, lever, float(sigma[0]), np.array([sigma[1], np.nan]), plain.ways
    )


def _count_ways(values: Array, certain: NDArray[np.bool_] | bool = True) -> int:
    """Counts the signs that values (n,) certainly have, ignoring a small fraction of all."""
    least = ONE_WAY * max(float(np.abs(values).mean()), STILL)
    return sum(
        float((certain * np.maximum(s * values, 0.0)).mean()) > least
        for s in (1.0, -1.0)
    )


def apply_mounting(calibration: Calibration, mounting: Mounting | None) -> Calibration:
    """Adds the significant parts of a mounting, and all uncertainties."""
    if mounting is None:
        return calibration
    estimates = {
        "rotation_rad": (mounting.rotation, mounting.rotation_sigma),
        "lever_arm_x_m": (float(mounting.lever[0]), float(mounting.lever_sigma[0])),
        "lever_arm_y_m": (float(mounting.lever[1]), float(mounting.lever_sigma[1])),
    }
    certain = {}
    uncertainty = dict(calibration.uncertainty)
    for name, (value, sigma) in estimates.items():
        certain[name] = clocks.keep_if_certain(value, sigma, MIN_LENGTH)
        if not np.isnan(sigma):
            uncertainty[name] = sigma
    return replace(
        calibration,
        rotation_rad=certain["rotation_rad"],
        lever_arm_m=(certain["lever_arm_x_m"], certain["lever_arm_y_m"]),
        uncertainty=uncertainty,
    )


def estimate_mounting_without_lateral_motion(
    motion: TwistIntervals, forward: Array, noise: float = 0.0
) -> Mounting | None:
    """Estimates the mounting of a robot that never moves sideways; None if the drive lacks motion.

    Turning within the noise of the heading [rad] does not count.
    """
    # The lateral speed of the tracked point is then yaw rate x lever arm: `cos(rotation) uy -
    # sin(rotation) ux - lever_x wz = 0`, the direction in which the twists have no extent. With a
    # single curvature the lever arm is set to zero. Only the sign of the speed (n,) matters.
    rows = motion.twist * np.array([1.0, 1.0, TURN_SCALE_M])
    size, axes = np.linalg.svd(rows, full_matrices=False)[1:]
    size = size / np.sqrt(len(rows))
    if size[0] < STILL:
        return None
    lever = 0.0
    lever_sigma = np.nan
    if size[1] < max(DISTINCT * size[2], MIN_SECOND * size[0]):
        sigma = size[1] / size[0] / np.sqrt(len(rows))
        travel = float(np.arctan2(axes[0, 1], axes[0, 0]))
    else:
        normal = axes[2]
        flat = float(np.hypot(normal[0], normal[1]))
        if flat < FLAT:
            return None
        sigma = size[2] / size[1] / np.sqrt(len(rows)) / flat
        travel = float(np.arctan2(-normal[0], normal[1]))
        lever = -float(normal[2]) * TURN_SCALE_M / flat
        lever_sigma = sigma * TURN_SCALE_M
    along = motion.twist[:, :2] @ np.array([np.cos(travel), np.sin(travel)])
    if float(along @ forward) < 0.0:
        travel = travel + np.pi
        lever = -lever
    return Mounting(
        float(wrap_angle(travel)),
        np.array([lever, 0.0]),
        float(sigma),
        np.array([lever_sigma, np.nan]),
        _count_turns(motion, noise),
    )


def _count_turns(motion: TwistIntervals, noise: float) -> int:
    """Counts the ways in which a robot turned beyond the noise of its heading [rad]."""
    turn = motion.twist[:, 2]
    span = motion.end - motion.start
    return _count_ways(turn, np.abs(turn) > CERTAIN * np.sqrt(2.0) * noise / span)


def estimate_lateral_lever(
    motion: TwistIntervals, rotation: float, speed: Array
) -> tuple[float, float]:
    """Estimates the lever arm along y and its uncertainty [m] from a speed (n,); may be NaN."""
    # `ux = gain speed - lever_y wz`: the outside of a curve is faster.
    along = rotate(motion.twist[:, :2], -rotation)[:, 0]
    chi = np.stack([speed, motion.twist[:, 2]], axis=1)
    size = np.linalg.svd(chi * np.array([1.0, TURN_SCALE_M]), compute_uv=False)
    if size[1] < 2.0 * MIN_SECOND * size[0]:
        return 0.0, float("nan")
    beta = np.linalg.lstsq(chi, along, rcond=None)[0]
    return -float(beta[1]), float(estimate_standard_errors(chi, along - chi @ beta)[1])


def _estimate_by_commands(
    drive: Drive, timing: clocks.TimingEstimate
) -> Mounting | None:
    """Estimates an omnidirectional robot's mounting; None unless it moved along x, y and turned."""
    recording = drive.recording
    spec = drive.spec
    twists = drive.twists
    inferred = recording.state is None and any(v.twist for v in spec.state)
    if not spec.state or inferred:
        begin = twists.start + timing.offset - timing.latency
        command = average_held(
            recording.command, spec, begin, begin + twists.end - twists.start
        )
        expected = _predict_twists(spec, command)
    else:
        states = clocks.average_expected_states(drive, twists, timing)
        if recording.state is None:
            command = states[:, np.argsort(list_followed_commands(spec))]
            expected = _predict_twists(spec, command)
        elif has_textbook(spec):
            expected = textbook(spec).twist(states)
        else:
            return None  # nothing says how its states move it
    # of base_link, up to one factor
    return estimate_mounting_by_twists(twists, expected)


def estimate_mounting_by_twists(
    motion: TwistIntervals, expected: Array
) -> Mounting | None:
    """Estimates the mounting by twists (n, 3) of `base_link` that are known up to one factor.

    Its errors treat blocks of the drive as independent, because slip and delays last for a while.
    """
    size = np.linalg.svd(expected, compute_uv=False)
    if size[2] <= MIN_SECOND * size[0]:
        return None
    gain = np.linalg.lstsq(expected, motion.twist, rcond=None)[0]
    sigma = _estimate_gain_errors(motion, expected, motion.twist - expected @ gain)
    sine = gain[0, 1] - gain[1, 0]  # both times twice the factor
    cosine = gain[0, 0] + gain[1, 1]
    sine_sigma = np.hypot(sigma[0, 1], sigma[1, 0])
    cosine_sigma = np.hypot(sigma[0, 0], sigma[1, 1])
    rotation = float(np.arctan2(sine, cosine))
    rotation_sigma = np.hypot(cosine * sine_sigma, sine * cosine_sigma)
    rotation_sigma /= sine**2 + cosine**2
    across = rotate(gain[2, :2], -rotation) / gain[2, 2]  # (-lever_y, lever_x)
    return Mounting(
        rotation,
        np.array([across[1], -across[0]]),
        float(rotation_sigma),
        np.full(2, float(sigma[2, :2].max() / abs(gain[2, 2]))),
        2,
    )


def _estimate_gain_errors(
    motion: TwistIntervals, expected: Array, rest: Array
) -> Array:
    """Returns the standard errors (3, 3) of the gain of the expected twists (n, 3).

    `rest` (n, 3) is what the gain leaves of the measured ones.
    """
    edges = np.linspace(motion.start[0], motion.end[-1], BLOCKS + 1)
    block = np.searchsorted(edges[1:-1], motion.start, "right")
    errors = [estimate_clustered_errors(expected, column, block) for column in rest.T]
    return np.stack(errors, axis=1)


def _predict_twists(spec: RobotSpec, command: Array) -> Array:
    """Returns twists (n, 3) up to factors; the third may be a steering angle."""
    if spec.takes_cmd_vel:
        return spec.to_fields(command)
    return compute_steady_twist(spec, command)
