"""The shield: passes only commands from which the robot can stop before the nearest obstacle."""
# The footprint is swept along all arcs between recent commands, odometry and the present command,
# while the scan is old, the next decision takes and the robot reacts, then brakes; a command is
# scaled down, on its path, until no obstacle is swept (dynamic window of Fox, Burgard, Thrun 1997).
# An obstacle may approach if it is where the robot saw free space a moment ago.

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.gate import ground, shield_kernels
from nics_drl_bridge.gate import state as records
from nics_drl_bridge.gate.inputs import Scan
from nics_drl_bridge.gate.scan_motion import extrapolate_pose
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Ground,
    Motion,
    ShieldConfig,
    View,
)
from nics_drl_bridge.gate.stops import compute_age
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.sim.collision_kernels import Outline

Ranges = NDArray[np.float32]
Flags = NDArray[np.bool_]
ALIKE = 0.9  # share of a bound from which on a stop that is shorter needs no sweep of its own
FINEST = 6  # bisections of the scale
SPEEDS, TURNS = 3, 9
"""Arcs of the family: number of speeds along each axis, and number of turn rates."""
CREEP = 0.1  # a speed that is not safe at this [m/s] would use up what a turn on the spot needs
# above this speed the ratio of turn rate to speed gives the curvature [m/s]
MOVING = 0.1
CALM = 0.5  # share of its deceleration with which the robot should stop when nothing is sudden
STEP = 0.02  # distance between two checked places of the footprint on an arc [m]
WALL_M = 0.05  # greatest distance between places of a wall on the footprint [m]
MEMORY_S, SPACING_S = 0.45, 0.09
"""Greatest age of a scan that the newest is compared with, and least time between them [s]."""
TOLERANCE_M, DEVIATIONS = 0.03, 3.0
"""Margin before the end of an old beam [m], plus this many standard deviations of its range."""


def add_view(config: GateConfig, state: GateState, scan: Scan) -> tuple[View, ...]:
    """Returns the earlier views that still count, oldest first, then that of a new scan."""
    if config.shield is None or state.odometry is None:
        return ()
    pose = extrapolate_pose(state.odometry, scan.stamp_ns, MEMORY_S)
    kept: list[View] = []
    for view in state.views:
        young = (scan.stamp_ns - view.stamp_ns) * S_PER_NS <= MEMORY_S
        if young and (
            not kept or (view.stamp_ns - kept[-1].stamp_ns) * S_PER_NS >= SPACING_S
        ):
            kept.append(view)
    return (*kept, View(scan.stamp_ns, pose, scan.ranges))


def find_movers(
    config: GateConfig, shield: ShieldConfig, views: tuple[View, ...]
) -> Flags:
    """Returns which beams (B,) of the newest view end on movers; a neighbour has to agree."""
    newest = views[-1]
    angles = config.beam_angles
    marked = np.zeros(len(newest.ranges), np.bool_)
    if len(angles) < 2 or shield.obstacle_speed == 0.0:
        return marked
    lidar = _get_beams(config)
    noise, share = (DEVIATIONS * std for std in shield.range_noise)
    for view in views[:-1]:
        moved = geometry.between(view.pose, newest.pose)
        shield_kernels.mark_entered(
            marked,
            newest.ranges,
            view.ranges,
            lidar,
            moved,
            shield.range_max,
            (TOLERANCE_M + noise, share),
        )
    beside = np.zeros_like(marked)
    beside[1:] |= marked[:-1]
    beside[:-1] |= marked[1:]
    return marked & beside


def returns(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, moves: Flags
) -> Array:
    """Returns end points (P, 3) of the beams [m], and how fast each may approach [m/s]."""
    hit = np.isfinite(ranges)
    speeds = np.where(moves[hit], shield.obstacle_speed, 0.0)
    return _ends(
        config, config.beam_angles[hit], ranges[hit].astype(np.float64), speeds
    )


def place_too_close(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, moves: Flags
) -> Array:
    """Returns points (P, 3) at the least range for beams too close to measure (`-inf`) [m]."""
    near = np.isneginf(ranges)
    return _ends(
        config, config.beam_angles[near], np.full(near.sum(), config.range_min), 0.0
    )


def place_unknown(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, moves: Flags
) -> Array:
    """Returns a wall (P, 3) on the footprint wherever too many beams, or all, are unknown."""
    bearings, wall = _sample_footprint(shield, config.mount, len(ranges))
    angles = config.beam_angles + config.mount[2]
    half = shield.unknown_width / 2.0
    known, every = (
        _count_within(bearings, some, half)
        for some in (angles[~np.isnan(ranges)], angles)
    )
    spacing = angles[1] - angles[0] if len(ranges) > 1 else 2.0 * np.pi
    whole = (
        shield.unknown_width / spacing
    )  # at the end of the lidar's view it has fewer
    least = (1.0 - shield.unknown_share) * np.where(every < int(whole), every, whole)
    return np.pad(wall[known < least], ((0, 0), (0, 1)))


@cache
def _sample_footprint(
    shield: ShieldConfig, mount: tuple[float, float, float], count: int
) -> tuple[Array, Array]:
    """Returns places (M, 2) around the footprint, and their bearings (M,) from the lidar."""
    corners = np.array(shield.outline)
    if not len(corners):  # as seen from the middle
        bearings = np.linspace(-np.pi, np.pi, count, endpoint=False)
        wall = shield.footprint_radius * np.stack([np.cos(bearings), np.sin(bearings)])
        return bearings, wall.T
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    parts = [(a, b, math.ceil(np.hypot(*(b - a)) / WALL_M)) for a, b in sides]
    wall = np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in parts])
    return np.arctan2(wall[:, 1] - mount[1], wall[:, 0] - mount[0]), wall


def _count_within(bearings: Array, angles: Array, half: float) -> NDArray[np.int64]:
    """Returns how many angles (B,) lie around each bearing (M,), up to an angle [rad] beside it."""
    angles = np.sort(np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)
    around = np.concatenate([angles - 2.0 * np.pi, angles, angles + 2.0 * np.pi])
    return np.searchsorted(around, bearings + half) - np.searchsorted(
        around, bearings - half
    )


EVIDENCE = (returns, place_too_close, place_unknown)


def _ends(
    config: GateConfig, angles: Array, ranges: Array, speeds: Array | float
) -> Array:
    x, y, heading = config.mount
    angles = angles + heading
    speeds = np.broadcast_to(speeds, ranges.shape)
    return np.stack(
        [x + ranges * np.cos(angles), y + ranges * np.sin(angles), speeds], axis=1
    )


def update_ground(
    config: GateConfig, views: tuple[View, ...], before: Ground | None
) -> Ground | None:
    """Returns what is known after the newest view of where the lidar never looks, if anywhere."""
    given = config.shield
    angles = config.beam_angles
    if given is None or not views or len(angles) < 2:
        return None
    lidar = _get_beams(config)
    seen = abs(lidar.step) * len(angles)
    if 2.0 * np.pi - seen < given.unknown_share * given.unknown_width:
        return None
    return ground.look(
        before, views[-1], lidar, get_body(given), given.range_max, TOLERANCE_M
    )


def find_obstacles(
    config: GateConfig,
    ranges: Ranges,
    views: tuple[View, ...],
    known: Ground | None = None,
) -> Array | None:
    """Returns obstacles (P, 3) in a scan (B,): x, y [m], greatest speed [m/s]; None if off."""
    given = config.shield
    if given is None:
        return None
    moves = (
        find_movers(config, given, views) if views else np.zeros(len(ranges), np.bool_)
    )
    found = [evidence(config, given, ranges, moves) for evidence in EVIDENCE]
    unseen = [] if known is None else [np.pad(known.unseen, ((0, 0), (0, 1)))]
    return np.concatenate([*found, *unseen])


def _get_beams(config: GateConfig) -> shield_kernels.MountedBeams:
    angles = config.beam_angles
    step = float(angles[1] - angles[0])
    return shield_kernels.MountedBeams(float(angles[0]), step, *config.mount)


@cache
def get_body(shield: ShieldConfig) -> shield_kernels.Body:
    """Returns the footprint that is swept."""
    corners = np.array(shield.outline, np.float64).reshape(-1, 2)
    reach = float(np.hypot(*corners.T).max(initial=0.0))
    outline = Outline(corners, 0, len(corners))
    radius = shield.footprint_radius
    return shield_kernels.Body(
        outline, radius, reach, shield.margin, shield.lever, shield.order
    )


def warm_up() -> None:
    """Compiles what `shield` calls: that takes seconds, which a moving robot does not have."""
    shield_kernels.fill_grid(np.zeros(3), np.zeros(3), np.ones(3, np.int64))
    body = get_body(ShieldConfig(0.0, 1.0, 0.0, 0.0, footprint_radius=1.0))
    shield_kernels.is_free(np.zeros((1, 3)), np.zeros((1, 3)), body, 0.0, 1.0, STEP)
    lidar = shield_kernels.MountedBeams(0.0, 0.1, 0.0, 0.0, 0.0)
    scan = np.ones(1, np.float32)
    shield_kernels.mark_entered(
        np.zeros(1, np.bool_), scan, scan, lidar, np.zeros(3), 1.0, (0.0, 0.0)
    )
    view = View(0, np.zeros(3), scan)
    ground.look(
        ground.look(None, view, lidar, body, 1.0, 0.0), view, lidar, body, 1.0, 0.0
    )


def shield(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Returns the greatest part of a motion from which it can stop, braking harder if needed."""
    if config.shield is None or config.limits is None or state.obstacles is None:
        return motion
    linear = config.limits.linear
    turn = config.limits.turn
    turning = motion.value[turn].any()
    speed = np.abs(motion.value[linear]).max(initial=0.0)
    if not (turning or speed):
        return motion

    def part(ahead: float, about: float) -> Array:
        return motion.value * np.where(linear, ahead, np.where(turn, about, 1.0))

    def safe(ahead: float, about: float) -> bool:
        return _is_safe(config, state, part(ahead, about), now)

    on_the_spot = bool(turning) and config.shield.wheelbase == 0.0
    creeps = on_the_spot and 0.0 < speed < CREEP
    if safe(1.0, 1.0) and (not creeps or safe(CREEP / speed, 1.0)):
        return motion
    # A way that is barred bars no turn on the spot: else a robot could not turn away from it.
    turns = bool(turning) and safe(0.0, 1.0)
    low = _find_maximum(lambda share: safe(share, 1.0 if turns else share))
    if on_the_spot and low * speed < CREEP:
        if turns:
            low = 0.0
        elif speed and safe(
            CREEP / speed, 0.0
        ):  # nor does a turn that is barred bar the way back
            value = part(_find_maximum(lambda share: safe(share, 0.0)), 0.0)
            return records.replace(
                motion, value=value, slope=0.0 * value, shielded=True
            )
    value = part(low, 1.0 if turns else low)
    slope = np.where(turn & turns, motion.slope, 0.0)
    return records.replace(motion, value=value, slope=slope, shielded=True)


def _find_maximum(safe: Callable[[float], bool]) -> float:
    """Greatest safe share of a motion, found by bisection."""
    if safe(1.0):
        return 1.0
    low = 0.0
    high = 1.0
    for _ in range(FINEST):
        middle = (low + high) / 2.0
        low, high = (middle, high) if safe(middle) else (low, middle)
    return low


def _is_safe(config: GateConfig, state: GateState, value: Array, now: float) -> bool:
    """True if the robot could still stop, and could do so without a jolt."""
    given = config.shield
    points = state.obstacles
    if given is None or points is None:
        return True
    # What further sensors show counts as standing.
    seen_further = [np.pad(sensor.points, ((0, 0), (0, 1))) for sensor in state.sensors]
    points = np.concatenate([points, *seen_further])
    body = get_body(given)
    odometry = np.zeros(3) if state.odometry is None else state.odometry.twist
    old = max(
        0.0,
        compute_age(state.scans, now),
        *(compute_age(s.arrivals, now) for s in state.sensors),
    )
    # Commands that the scan does not show yet: since it was taken, or within the latency before.
    if given.turn is None:
        late = given.latency_s
    else:
        late = max(given.latency_s, given.turn.reaction_s)
    since = now - old - late
    ends = [time for time, _ in state.recent[1:]]
    past = [
        one[1]
        for one, end in zip(state.recent, [*ends, now], strict=False)
        if end >= since
    ]
    react = given.hold_s + given.latency_s
    calm = 1.0 / config.scan_rate + react + given.latency_s
    hard = old + react
    standing = points * (
        1.0,
        1.0,
        0.0,
    )  # static: against fast obstacles a calm stop is no use
    for seen, commands, twist, blind, share, latencies in (
        (standing, [value], None, calm, CALM, 2.0),
        (points, [*past, state.value, value], odometry, hard, 1.0, 1.0),
    ):
        twists = _span_twists(config, given, np.array(commands), twist)
        for stop in list_sweeps(given, body, blind, share, latencies):
            if not shield_kernels.is_free(seen, twists, *stop, STEP):
                return False
    return True


def list_sweeps(
    given: ShieldConfig,
    body: shield_kernels.Body,
    blind: float,
    share: float,
    latencies: float,
) -> list[tuple[shield_kernels.Body, float, float]]:
    """Returns body, time before it brakes [s] and deceleration [m/s^2] of the stops to sweep.

    Where the turn brakes apart from the speed, either may end sooner than it is bound to.

    Args:
        given: the stopping behaviour.
        body: that is swept.
        blind: time before the speed is braked, with as many latencies as given [s].
        share: of the decelerations with which the robot brakes.
        latencies: number of them within that time.
    """
    turn = given.turn
    deceleration = share * given.deceleration
    if turn is None:
        return [(body, blind, deceleration)]
    stops = []
    shares = [(1.0, 1.0)]
    if turn.least_turn < ALIKE:
        shares.append((1.0, turn.least_turn))
    if turn.least_path < ALIKE:
        shares.append((turn.least_path, 1.0))
    for path_share, turn_share in shares:
        path_blind = blind - (1.0 - path_share) * given.latency_s
        turn_latencies = latencies - (1.0 - turn_share)
        turn_blind = (
            blind - latencies * given.latency_s + turn_latencies * turn.reaction_s
        )
        braked = body._replace(
            turn_later=turn_blind - path_blind,
            turn_deceleration=share * turn.deceleration / turn_share,
        )
        stops.append((braked, path_blind, deceleration / path_share))
    return stops


def _span_twists(
    config: GateConfig, given: ShieldConfig, commands: Array, odometry: Array | None
) -> Array:
    """Returns body twists (K, 3) between those of commands (n, C) and of odometry (3,), if any."""
    twists = np.zeros((len(commands), 3))
    twists[:, list(config.fields)] = commands
    if given.wheelbase > 0.0:
        return _span_car_twists(given.wheelbase, twists, odometry)
    if odometry is not None:
        twists = np.concatenate([twists, odometry[None]])
    twists = _add_drift(given, twists)
    low = twists.min(axis=0)
    high = twists.max(axis=0)
    counts = np.where(high > low, (SPEEDS, SPEEDS, TURNS), 1)
    return np.asarray(shield_kernels.fill_grid(low, high, counts))


def _add_drift(given: ShieldConfig, twists: Array) -> Array:
    """Returns twists (n, 3), and those of the arcs between which the robot leaves theirs."""
    drift = given.drift
    if drift.is_none:
        return twists
    scale = np.array([1.0, 1.0, given.footprint_radius])
    greatest = np.abs(twists * scale).max(axis=1, keepdims=True)
    is_lesser = np.abs(twists * scale) < greatest
    bound = drift.share * greatest / scale
    rows = [twists]
    for factor in (drift.least, drift.greatest):
        changed = np.clip(factor * twists, -bound, bound)
        rows.append(np.where(is_lesser, changed, twists))
    return np.concatenate(rows)


def _span_car_twists(
    wheelbase: float, commands: Array, odometry: Array | None
) -> Array:
    """Returns a car's twists: curvature does not depend on speed; braking steers it straight."""
    bends = [0.0, *np.tan(commands[:, 2]) / wheelbase]
    speeds = list(commands[:, 0])
    if odometry is not None:
        speeds.append(odometry[0])
        if abs(odometry[0]) > MOVING:
            bends.append(odometry[2] / odometry[0])
    grid = np.linspace(
        min(bends), max(bends), 2 * TURNS if max(bends) > min(bends) else 1
    )
    ends = [speed for speed in sorted({max(speeds), min(speeds)}) if speed != 0.0]
    speed, bend = np.meshgrid(ends, grid)
    return np.stack([speed, np.zeros_like(speed), speed * bend], axis=-1).reshape(-1, 3)
