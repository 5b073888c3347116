"""The shield: passes only commands from which the robot can stop before the nearest obstacle."""
# The footprint is swept along all arcs between recent commands, odometry and the present command
# for as long as the scan is old, the next decision takes and the robot reacts; then it brakes. A
# command is reduced until no obstacle is swept (dynamic window of Fox, Burgard, Thrun 1997). An
# obstacle may approach if it stands where the robot saw free space a moment ago.

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.gate import ground, shield_kernels
from nics_drl_bridge.gate.inputs import Scan
from nics_drl_bridge.gate.scan_motion import extrapolate_pose
from nics_drl_bridge.gate.shield_kernels import Body, MountedBeams, Tolerance
from nics_drl_bridge.gate.state import (
    GateConfig,
    GateState,
    Ground,
    Motion,
    Ranges,
    ShieldConfig,
    View,
    replace,
)
from nics_drl_bridge.gate.stops import compute_age
from nics_drl_bridge.interface import S_PER_NS, Array
from nics_drl_bridge.sim.collision_kernels import Outline

Flags = NDArray[np.bool_]
TimedCommand = tuple[float, Array]  # time of its publication [s], and its values (C,)
BISECTIONS = 6  # of the scale by which a motion is reduced
# A robot that turns on the spot does not approach an obstacle slower than this [m/s]: it would use
# up the space that a turn on the spot needs.
CREEP_SPEED = 0.1
# Grid of twists that are swept: speeds along each axis, turn rates, and curvatures of a car.
SPEED_COUNT = 3
TURN_RATE_COUNT = 9
CURVATURE_COUNT = 18
# Above this speed [m/s] the curvature of a car is computed from its odometry.
CURVATURE_SPEED = 0.1
CALM_BRAKING = (
    0.5  # fraction of the deceleration that a stop may need if nothing is sudden
)
# A stop that is shorter than its bound gets a sweep of its own below this fraction of the bound.
SHORT_STOP = 0.9
STEP = 0.02  # distance between two places at which the footprint is checked [m]
WALL_SPACING = 0.05  # maximum distance between the points of a wall [m]
MEMORY_S = 0.45  # maximum age of a scan that the newest one is compared with [s]
SPACING_S = 0.09  # minimum time between two such scans [s]
# A beam ends in space that was free if it ends this far [m], plus this many standard deviations of
# its range, before the end of an old beam.
TOLERANCE = 0.03
DEVIATIONS = 3.0


def add_view(config: GateConfig, state: GateState, scan: Scan) -> tuple[View, ...]:
    """Returns the earlier views that still count, oldest first, then that of a new scan."""
    if config.shield is None or state.odometry is None:
        return ()
    pose = extrapolate_pose(state.odometry, scan.stamp_ns, MEMORY_S)
    kept: list[View] = []
    for view in state.views:
        age_s = (scan.stamp_ns - view.stamp_ns) * S_PER_NS
        # The stamps of the lidar may have jumped back since the view.
        if not 0.0 < age_s <= MEMORY_S:
            continue
        if not kept or (view.stamp_ns - kept[-1].stamp_ns) * S_PER_NS >= SPACING_S:
            kept.append(view)
    return (*kept, View(scan.stamp_ns, pose, scan.ranges))


def find_movers(
    config: GateConfig, shield: ShieldConfig, views: tuple[View, ...]
) -> Flags:
    """Returns which beams (B,) of the newest view end on movers; a neighbour has to agree."""
    newest = views[-1]
    entered = np.zeros(len(newest.ranges), np.bool_)
    if shield.obstacle_speed == 0.0:
        return entered
    lidar = _get_beams(config)
    constant, proportional = shield.range_noise
    tolerance = Tolerance(TOLERANCE + DEVIATIONS * constant, DEVIATIONS * proportional)
    for view in views[:-1]:
        shield_kernels.mark_entered(
            entered,
            newest.ranges,
            view.ranges,
            lidar,
            geometry.between(view.pose, newest.pose),
            shield.range_max,
            tolerance,
        )
    neighbour_entered = np.zeros_like(entered)
    neighbour_entered[1:] |= entered[:-1]
    neighbour_entered[:-1] |= entered[1:]
    return entered & neighbour_entered


def place_returns(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns end points (P, 3) of the beams [m], and how fast each may approach [m/s]."""
    hit = np.isfinite(ranges)
    speeds = np.where(is_mover[hit], shield.obstacle_speed, 0.0)
    return _compute_ends(
        config, config.beam_angles[hit], ranges[hit].astype(np.float64), speeds
    )


def place_too_close(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns points (P, 3) at the minimum range for beams too close to measure (`-inf`) [m]."""
    near = np.isneginf(ranges)
    return _compute_ends(
        config, config.beam_angles[near], np.full(near.sum(), config.range_min), 0.0
    )


def place_unknown(
    config: GateConfig, shield: ShieldConfig, ranges: Ranges, is_mover: Flags
) -> Array:
    """Returns a wall (P, 3) on the footprint wherever too many beams, or all, are unknown."""
    bearings, wall = _sample_footprint(shield, config.mount, len(ranges))
    angles = config.beam_angles + config.mount[2]
    half_width = shield.unknown_width / 2.0
    known_count = _count_within(bearings, angles[~np.isnan(ranges)], half_width)
    count = _count_within(bearings, angles, half_width)
    spacing = 2.0 * np.pi
    if len(ranges) > 1:
        spacing = angles[1] - angles[0]
    full_count = shield.unknown_width / spacing
    # At the edge of the lidar's view there are fewer beams than in a whole window.
    expected_count = np.where(count < int(full_count), count, full_count)
    is_unknown = known_count < (1.0 - shield.unknown_share) * expected_count
    return _as_static(wall[is_unknown])


@cache
def _sample_footprint(
    shield: ShieldConfig, mount: tuple[float, float, float], count: int
) -> tuple[Array, Array]:
    """Returns the bearings (M,) from the lidar of points around the footprint, and these (M, 2).

    Bearings of a circle, which gets `count` points, are those from its centre.
    """
    corners = np.array(shield.outline)
    if not len(corners):
        bearings = np.linspace(-np.pi, np.pi, count, endpoint=False)
        wall = shield.footprint_radius * np.stack([np.cos(bearings), np.sin(bearings)])
        return bearings, wall.T
    edges = []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        pieces = math.ceil(np.hypot(*(end - begin)) / WALL_SPACING)
        edges.append(np.linspace(begin, end, pieces, endpoint=False))
    wall = np.concatenate(edges)
    return np.arctan2(wall[:, 1] - mount[1], wall[:, 0] - mount[0]), wall


def _count_within(
    bearings: Array, angles: Array, half_width: float
) -> NDArray[np.int64]:
    """Returns how many angles (B,) lie within half a width of each bearing (M,) [rad]."""
    angles = np.sort(np.mod(angles + np.pi, 2.0 * np.pi) - np.pi)
    turns = np.concatenate([angles - 2.0 * np.pi, angles, angles + 2.0 * np.pi])
    begin = np.searchsorted(turns, bearings - half_width)
    return np.searchsorted(turns, bearings + half_width) - begin


# What counts as an obstacle in a scan.
EVIDENCE = (place_returns, place_too_close, place_unknown)


def _compute_ends(
    config: GateConfig, angles: Array, ranges: Array, speeds: Array | float
) -> Array:
    """Returns ends (P, 3) of beams in the robot's frame [m], and the speeds of what is there."""
    x, y, heading = config.mount
    angles = angles + heading
    speeds = np.broadcast_to(speeds, ranges.shape)
    return np.stack(
        [x + ranges * np.cos(angles), y + ranges * np.sin(angles), speeds], axis=1
    )


def _as_static(points: Array) -> Array:
    """Returns obstacles (P, 3) at points (P, 2), with a speed of zero."""
    return np.pad(points, ((0, 0), (0, 1)))


def update_ground(
    config: GateConfig, views: tuple[View, ...], before: Ground | None
) -> Ground | None:
    """Returns the ground known after the newest view; None for a lidar that sees all around."""
    shield = config.shield
    beams = len(config.beam_angles)
    if shield is None or not views:
        return None
    lidar = _get_beams(config)
    blind_angle = 2.0 * np.pi - abs(lidar.step) * beams
    if blind_angle < shield.unknown_share * shield.unknown_width:
        return None
    return ground.look(
        before, views[-1], lidar, get_body(shield), shield.range_max, TOLERANCE
    )


def find_obstacles(
    config: GateConfig,
    ranges: Ranges,
    views: tuple[View, ...],
    known: Ground | None = None,
) -> Array | None:
    """Returns obstacles (P, 3) in a scan (B,): x, y [m], maximum speed [m/s]; None if off."""
    shield = config.shield
    if shield is None:
        return None
    is_mover = np.zeros(len(ranges), np.bool_)
    if views:
        is_mover = find_movers(config, shield, views)
    obstacles = [place(config, shield, ranges, is_mover) for place in EVIDENCE]
    if known is not None:
        obstacles.append(_as_static(known.unseen))
    return np.concatenate(obstacles)


def _get_beams(config: GateConfig) -> MountedBeams:
    angles = config.beam_angles
    step = float(angles[1] - angles[0])
    return MountedBeams(float(angles[0]), step, *config.mount)


@cache
def get_body(shield: ShieldConfig) -> Body:
    """Returns the footprint that is swept."""
    corners = np.array(shield.outline, np.float64).reshape(-1, 2)
    reach = float(np.hypot(*corners.T).max(initial=0.0))
    outline = Outline(corners, 0, len(corners))
    return Body(
        outline,
        shield.footprint_radius,
        reach,
        shield.margin,
        shield.lever,
        shield.order,
    )


def warm_up() -> None:
    """Compiles the kernels of `shield`; that takes seconds, which a moving robot does not have."""
    shield_kernels.fill_grid(np.zeros(3), np.zeros(3), np.ones(3, np.int64))
    body = get_body(ShieldConfig(0.0, 1.0, 0.0, 0.0, footprint_radius=1.0))
    shield_kernels.is_free(np.zeros((1, 3)), np.zeros((1, 3)), body, 0.0, 1.0, STEP)
    lidar = MountedBeams(0.0, 0.1, 0.0, 0.0, 0.0)
    ranges = np.ones(1, np.float32)
    shield_kernels.mark_entered(
        np.zeros(1, np.bool_),
        ranges,
        ranges,
        lidar,
        np.zeros(3),
        1.0,
        Tolerance(0.0, 0.0),
    )
    view = View(0, np.zeros(3), ranges)
    before: Ground | None = None
    for _ in range(2):
        before = ground.look(before, view, lidar, body, 1.0, 0.0)


def shield(config: GateConfig, state: GateState, motion: Motion, now: float) -> Motion:
    """Reduces a motion until the robot can stop before every obstacle.

    A motion from which the robot can stop passes as it is. Otherwise:

    - If the turn without any speed is safe, the turn rate stays and only the speed is reduced: an
      obstacle ahead must not keep the robot from turning away.
    - If it is not, speed and turn rate are scaled alike, which keeps the robot on its path. If that
      leaves a creep, but straight on the robot could drive faster, the turn is left out instead: an
      obstacle at its side must not keep the robot from leaving straight.

    A creep is a speed below `CREEP_SPEED` of a robot that can turn on the spot. It would end so
    near to an obstacle that the robot could not turn any more. So a commanded creep only passes
    where the robot could also stop from `CREEP_SPEED`, and beside a full turn it becomes zero.
    """
    if config.shield is None or config.limits is None or state.obstacles is None:
        return motion
    is_speed = config.limits.linear
    is_turn_rate = config.limits.turn
    speed = float(np.abs(motion.value[is_speed]).max(initial=0.0))
    turns = bool(motion.value[is_turn_rate].any())
    turns_on_the_spot = turns and config.shield.wheelbase == 0.0
    if speed == 0.0 and not turns:
        return motion

    def scale_motion(speed_scale: float, turn_scale: float) -> Array:
        scales = np.where(
            is_speed, speed_scale, np.where(is_turn_rate, turn_scale, 1.0)
        )
        return motion.value * scales

    def can_stop(speed_scale: float, turn_scale: float) -> bool:
        return _can_stop(config, state, scale_motion(speed_scale, turn_scale), now)

    def can_stop_from_creep_speed(turn_scale: float) -> bool:
        return can_stop(CREEP_SPEED / speed, turn_scale)

    is_creep = turns_on_the_spot and 0.0 < speed < CREEP_SPEED
    if can_stop(1.0, 1.0) and (not is_creep or can_stop_from_creep_speed(1.0)):
        return motion
    # A steering angle is not scaled, so it goes on changing.
    slope = np.where(is_speed | is_turn_rate, 0.0, motion.slope)
    if turns and can_stop(0.0, 1.0):
        turn_scale = 1.0
        slope[is_turn_rate] = motion.slope[is_turn_rate]
        speed_scale = _find_maximum_scale(lambda scale: can_stop(scale, 1.0))
        if turns_on_the_spot and speed_scale * speed < CREEP_SPEED:
            speed_scale = 0.0
    else:
        speed_scale = _find_maximum_scale(lambda scale: can_stop(scale, scale))
        turn_scale = speed_scale
        would_creep = turns_on_the_spot and speed_scale * speed < CREEP_SPEED
        if would_creep and speed > 0.0 and can_stop_from_creep_speed(0.0):
            speed_scale = _find_maximum_scale(lambda scale: can_stop(scale, 0.0))
            turn_scale = 0.0
    value = scale_motion(speed_scale, turn_scale)
    return replace(motion, value=value, slope=slope, shielded=True)


def _find_maximum_scale(can_stop: Callable[[float], bool]) -> float:
    """Returns the maximum scale in [0, 1] from which the robot can stop, by bisection."""
    if can_stop(1.0):
        return 1.0
    low = 0.0
    high = 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        if can_stop(middle):
            low = middle
        else:
            high = middle
    return low


def _can_stop(config: GateConfig, state: GateState, value: Array, now: float) -> bool:
    """True if the robot can stop from a command (C,) in a calm stop and in a sudden one.

    Calm: obstacles stand still, and the robot brakes with half its deceleration once the next scan
    has shown them. Sudden: obstacles approach, the robot moves by any twist between its odometry
    and the commands that the scan does not show yet, and brakes as hard as it can.
    """
    shield = config.shield
    if shield is None or state.obstacles is None:
        return True
    sensor_points = [_as_static(sensor.points) for sensor in state.sensors]
    obstacles = np.concatenate([state.obstacles, *sensor_points])
    # Against fast obstacles a calm stop is no use.
    static_obstacles = obstacles * (1.0, 1.0, 0.0)
    reaction_s = shield.hold_s + shield.latency_s
    twists = _span_twists(config, shield, value[None], None)
    calm_s = 1.0 / config.scan_rate + reaction_s + shield.latency_s
    for stop in list_stops(shield, calm_s, CALM_BRAKING, latencies=2.0):
        if not shield_kernels.is_free(static_obstacles, twists, *stop, STEP):
            return False
    data_age_s = _compute_data_age(state, now)
    commands = _list_unshown_commands(shield, state, now, data_age_s)
    odometry = np.zeros(3)
    if state.odometry is not None:
        odometry = state.odometry.twist
    twists = _span_twists(
        config, shield, np.array([*commands, state.value, value]), odometry
    )
    for stop in list_stops(shield, data_age_s + reaction_s, 1.0, latencies=1.0):
        if not shield_kernels.is_free(obstacles, twists, *stop, STEP):
            return False
    return True


def _compute_data_age(state: GateState, now: float) -> float:
    """Returns the age of the oldest data that show obstacles [s], at least 0."""
    arrivals = [state.scans, *(sensor.arrivals for sensor in state.sensors)]
    return max(0.0, *(compute_age(topic, now) for topic in arrivals))


def append_command(
    config: GateConfig, state: GateState, command: Array, now: float
) -> tuple[TimedCommand, ...]:
    """Returns a new command (C,) after those that the shield may still need."""
    shield = config.shield
    if shield is None:
        return ()
    # No data are older than this when a motion is decided.
    oldest_s = now - config.scan_age_s - _get_longest_reaction(shield)
    return _select_in_force((*state.recent, (now, command)), oldest_s, now)


def _list_unshown_commands(
    shield: ShieldConfig, state: GateState, now: float, data_age_s: float
) -> list[Array]:
    """Returns the commands (C,) in force since the oldest data, or within a reaction before."""
    since_s = now - data_age_s - _get_longest_reaction(shield)
    return [command for _, command in _select_in_force(state.recent, since_s, now)]


def _get_longest_reaction(shield: ShieldConfig) -> float:
    """Returns the longest time after which the robot still follows an earlier command [s]."""
    if shield.turn is None:
        return shield.latency_s
    return max(shield.latency_s, shield.turn.reaction_s)


def _select_in_force(
    commands: tuple[TimedCommand, ...], since_s: float, now: float
) -> tuple[TimedCommand, ...]:
    """Returns those of the commands, oldest first, that were in force at `since_s` or later.

    A command is in force until the next one.
    """
    ends_s = [*(time for time, _ in commands[1:]), now]
    return tuple(
        command
        for command, end_s in zip(commands, ends_s, strict=False)
        if end_s >= since_s
    )


class Stop(NamedTuple):
    """A stop to be swept: the robot keeps its twist for a reaction time, then brakes."""

    body: Body
    reaction_s: float  # [s]
    deceleration: float  # [m/s^2]


def list_stops(
    shield: ShieldConfig, reaction_s: float, braking: float, latencies: float
) -> list[Stop]:
    """Returns the stops to sweep. If the turn brakes by itself, either may end early.

    Args:
        shield: the stopping behaviour.
        reaction_s: time until the speed is braked [s], which includes the latencies.
        braking: fraction of the decelerations with which the robot brakes.
        latencies: number of latencies in the reaction time.
    """
    body = get_body(shield)
    deceleration = braking * shield.deceleration
    turn = shield.turn
    if turn is None:
        return [Stop(body, reaction_s, deceleration)]
    fractions = [(1.0, 1.0)]
    if turn.least_turn < SHORT_STOP:
        fractions.append((1.0, turn.least_turn))
    if turn.least_path < SHORT_STOP:
        fractions.append((turn.least_path, 1.0))
    stops = []
    for path_fraction, turn_fraction in fractions:
        path_reaction_s = reaction_s - (1.0 - path_fraction) * shield.latency_s
        turn_latencies = latencies - (1.0 - turn_fraction)
        turn_reaction_s = (
            reaction_s - latencies * shield.latency_s + turn_latencies * turn.reaction_s
        )
        turning_body = body._replace(
            turn_later=turn_reaction_s - path_reaction_s,
            turn_deceleration=braking * turn.deceleration / turn_fraction,
        )
        stops.append(Stop(turning_body, path_reaction_s, deceleration / path_fraction))
    return stops


def _span_twists(
    config: GateConfig, shield: ShieldConfig, commands: Array, odometry: Array | None
) -> Array:
    """Returns body twists (K, 3) between those of commands (n, C) and of odometry (3,), if any."""
    twists = np.zeros((len(commands), 3))
    twists[:, list(config.fields)] = commands
    if shield.wheelbase > 0.0:
        return _span_car_twists(shield.wheelbase, twists, odometry)
    if odometry is not None:
        twists = np.concatenate([twists, odometry[None]])
    twists = _add_drift(shield, twists)
    low = twists.min(axis=0)
    high = twists.max(axis=0)
    counts = np.where(high > low, (SPEED_COUNT, SPEED_COUNT, TURN_RATE_COUNT), 1)
    return np.asarray(shield_kernels.fill_grid(low, high, counts))


def _add_drift(shield: ShieldConfig, twists: Array) -> Array:
    """Returns twists (n, 3), and those of the arcs between which the robot leaves theirs."""
    drift = shield.drift
    if drift.is_none:
        return twists
    scale = np.array([1.0, 1.0, shield.footprint_radius])
    speeds = np.abs(twists * scale)
    maximum = speeds.max(axis=1, keepdims=True)
    is_lesser = speeds < maximum
    bound = drift.share * maximum / scale
    rows = [twists]
    for factor in (drift.least, drift.greatest):
        changed = np.clip(factor * twists, -bound, bound)
        rows.append(np.where(is_lesser, changed, twists))
    return np.concatenate(rows)


def _span_car_twists(
    wheelbase: float, commands: Array, odometry: Array | None
) -> Array:
    """Returns a car's twists: curvature does not depend on speed; braking steers it straight."""
    curvatures = [0.0, *np.tan(commands[:, 2]) / wheelbase]
    speeds = list(commands[:, 0])
    if odometry is not None:
        speeds.append(odometry[0])
        if abs(odometry[0]) > CURVATURE_SPEED:
            curvatures.append(odometry[2] / odometry[0])
    low = min(curvatures)
    high = max(curvatures)
    count = CURVATURE_COUNT if high > low else 1
    extremes = [speed for speed in sorted({max(speeds), min(speeds)}) if speed != 0.0]
    speed, curvature = np.meshgrid(extremes, np.linspace(low, high, count))
    twists = np.stack([speed, np.zeros_like(speed), speed * curvature], axis=-1)
    return twists.reshape(-1, 3)
