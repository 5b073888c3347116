"""Checks data received from a robot against a model, and yields a finding for each fault."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array, wrap_angle
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.recording.heading import WINDOW_S, Turning, compare_turning
from nics_drl_bridge.report import doctor_facts
from nics_drl_bridge.report.doctor_facts import (
    CLOCK,
    CMD_VEL,
    GYRO,
    KINDS,
    ODOM,
    SCAN,
    Expected,
    Facts,
)
from nics_drl_bridge.robot.spec import RobotSpec

Mismatch = doctor_facts.Mismatch
Findings = Iterator[Mismatch]

# A drive with less motion does not determine scales.
LEAST_PATH_M = 0.3
LEAST_TURN_RAD = 0.3
TOLERANCE = 1.4  # maximum factor between the pose's differences and the twist
# Below this correlation a ratio of pose and twist is meaningless; the second one is for commands,
# which the robot follows with a delay and within its limits.
ALIKE = 0.8
LEAST_ALIKE = 0.3
# A step is a jump beyond this multiple of the top speed's, and beyond this length.
JUMP = 5.0
JUMP_M = 0.2
QUATERNION_TOLERANCE = 0.05
LEAST_STEPS = 10
# Window in which turns are compared if only a few seconds were received
SHORT_WINDOW_S = 2.0
UNITS = (
    (1000.0, "mm/s"),
    (100.0, "cm/s"),
    (3.6, "km/h"),
    (180.0 / np.pi, "degrees per second"),
)
RATE_TOLERANCE = 0.2
# Stamps this much after their arrival are from the future. Stamps this much before it are too old
# for the command gate, and even older ones show that the clocks differ.
FUTURE_S = 0.005
LATE_S = 0.35
OFFSET_S = 5.0
STALE_CLOCK_S = 1.0
BODY_FRAMES = ("base_link", "base_footprint")
ANGLE_TOLERANCE = 0.5  # tolerance of a beam's direction, in increments
# A value in more than this fraction of the beams is intended by the lidar.
ODD_FRACTION = 0.01

error = partial(Mismatch, "error")
warning = partial(Mismatch, "warning")
no_match = partial(error, "quality of service")
layout_error = partial(error, "beam layout", SCAN)
odometry_error = partial(error, "odometry", ODOM)
odometry_warning = partial(warning, "odometry", ODOM)
gyro_warning = partial(warning, "gyro", GYRO)


def examine(facts: Facts, expected: Expected) -> list[Mismatch]:
    """Runs all checks and returns their findings, errors first."""
    expected = doctor_facts.expect_present_lidar(facts, expected)
    checks = (
        check_presence,
        check_quality_of_service,
        check_publishers,
        check_frames,
        check_rates,
        check_latency,
        check_clock,
        check_layout,
        check_ranges,
        check_motion,
        check_turning,
    )
    findings: list[Mismatch] = []
    for check in checks:
        findings += check(facts, expected)
    named = [replace(finding, where=facts.names[finding.where]) for finding in findings]
    return sorted(named, key=lambda finding: finding.severity)


def check_presence(facts: Facts, _: Expected) -> Findings:
    """Finds missing topics, silent topics and wrong types."""
    for role in (SCAN, ODOM, CMD_VEL):
        ends = facts.topics.get(facts.names[role])
        types = () if ends is None else ends.types
        if len(types) > 1 or set(types) - set(KINDS[role]):
            fix = f"publish {KINDS[role][0]}, or remap a topic of that type"
            yield error("type", role, f"is of {' and '.join(types)}", fix)
        elif role == CMD_VEL:
            if facts.live and (ends is None or not ends.asks):
                fix = "start the base, or correct its namespace or its topic's name"
                yield error("missing topic", role, "it has no subscriber", fix)
        elif role not in facts.heard:
            what = "no message was received"
            hint = ""
            if ends is None:
                what = "there is no such topic"
                same_type = [
                    topic
                    for topic, its_ends in facts.topics.items()
                    if KINDS[role][0] in its_ends.types
                ]
                if same_type:
                    hint = f"; {', '.join(same_type)} is of its type: remap it"
            if facts.live:
                fix = f"start its driver, or correct namespace or ROS_DOMAIN_ID{hint}"
            else:
                fix = f"record it with the others, or name its --namespace{hint}"
            yield error("missing topic", role, what, fix)
        if doctor_facts.TWIST_STAMPED_TYPE in types and not facts.live:
            fix = "set `enable_stamped_cmd_vel` for the package's nodes that receive it"
            yield warning("type", role, "is a TwistStamped, not a Twist", fix)


def check_quality_of_service(facts: Facts, _: Expected) -> Findings:
    """Finds publishers and subscribers whose qualities of service are incompatible."""
    for role, name in facts.names.items():
        ends = facts.topics.get(name)
        if ends is None:
            continue
        best_effort = any(not offer.reliable for offer in ends.offers)
        if role != CLOCK and best_effort and any(ask.reliable for ask in ends.asks):
            what = "is published best effort, but a subscriber requires reliable: they never match"
            fix = "make the publisher reliable, or the subscriber best effort"
            yield no_match(role, what, fix)
        volatile = any(not offer.transient_local for offer in ends.offers)
        if volatile and any(ask.transient_local for ask in ends.asks):
            what = "is published volatile, a subscriber requires transient local: they never match"
            yield no_match(role, what, "make both volatile")


def check_publishers(facts: Facts, _: Expected) -> Findings:
    """Finds several publishers on topics that must have only one."""
    for role in (CMD_VEL, ODOM, SCAN, CLOCK):
        ends = facts.topics.get(facts.names[role])
        if ends is not None and len(ends.offers) > 1:
            what = f"has {len(ends.offers)} publishers, which override each other"
            fix = "stop all but one: joystick, navigation, a second simulator"
            yield error("publishers", role, what, fix)


def check_frames(facts: Facts, expected: Expected) -> Findings:
    """Checks names of frames against REP-105 and the lidar's frame."""
    fields = (
        (SCAN, "frames", (expected.lidar.frame,), "header.frame_id"),
        (ODOM, "frames", ("odom",), "header.frame_id"),
        (ODOM, "children", BODY_FRAMES, "child_frame_id"),
    )
    for role, attribute, good, place in fields:
        for frame in sorted(getattr(facts.heard.get(role), attribute, ())):
            if frame.rpartition("/")[2] in good and not frame.startswith("/"):
                continue  # the frames of a fleet's robots have prefixes
            fix = f"call it {good[0]!r} (REP-105), without a leading slash"
            if role == SCAN and frame not in ("", "map", "odom", *BODY_FRAMES):
                fix = f"call it {good[0]!r} in the driver, or set `frame: {frame}` in the lidar"
            finding = error if role == ODOM else warning
            yield finding("frame", role, f"{place} is {frame!r}, not {good[0]!r}", fix)


def check_rates(facts: Facts, expected: Expected) -> Findings:
    """Checks rates: the scan's as declared, and at least one odometry message per command."""
    for role, wanted in ((SCAN, expected.lidar.rate), (ODOM, 1.0 / expected.period_s)):
        rate = _measure_rate(facts, role)
        if rate is None:
            continue
        slow = rate < (1 - RATE_TOLERANCE) * wanted
        fast = rate > (1 + RATE_TOLERANCE) * wanted
        if slow or (fast and role == SCAN):
            bound = "at least " if role == ODOM else ""
            finding = error if slow else warning
            fix = "set the driver's rate; on a slow network look for losses (best effort, Wi-Fi)"
            if role == SCAN:
                fix += f", or set `rate: {rate:.3g}` in the lidar and generate the model again"
            what = f"arrives at {rate:.3g} Hz, expected {bound}{wanted:.3g} Hz"
            yield finding("rate", role, what, fix)


def _measure_rate(facts: Facts, role: str) -> float | None:
    heard = facts.heard.get(role)
    if heard is None or len(heard.arrivals_ns) <= 2:
        return None
    stamps = heard.stamps_ns
    times = heard.arrivals_ns
    if facts.clock_ns and len(stamps) > 2 and stamps[-1] > stamps[0]:
        times = stamps  # a simulation may run faster or slower than real time
    span = times[-1] - times[0]
    return (len(times) - 1) / (span * S_PER_NS) if span else None


def check_latency(facts: Facts, _: Expected) -> Findings:
    """Checks that messages are stamped, in order, and arrive in time, by `/clock` if present."""
    for role in (SCAN, ODOM):
        heard = facts.heard.get(role)
        if heard is None:
            continue
        stamps = np.array(heard.stamps_ns, dtype=np.int64)
        missing = int((stamps == 0).sum())
        if missing:
            what = f"{missing} of {len(stamps)} messages are not stamped"
            yield error("stamp", role, what, "make the driver stamp its messages")
            continue
        back = int((np.diff(stamps) < 0).sum())
        if back:
            what = f"{back} stamps are earlier than the previous one"
            fix = (
                "look for a second publisher, or for a clock that is set while it runs"
            )
            yield error("stamp", role, what, fix)
        times = np.array(heard.arrivals_ns, dtype=np.int64)
        if facts.clock_ns:
            # The clock tick of a message is sent with it, and may arrive after it.
            ticks = facts.heard[CLOCK].arrivals_ns
            place = np.searchsorted(ticks, times, side="right")
            times = np.array(facts.clock_ns)[place.clip(0, len(ticks) - 1)]
        age = float(np.median(times - stamps)) * S_PER_NS
        if -FUTURE_S <= age <= LATE_S:
            continue
        side = "after" if age < 0 else "before"
        fix = "stamp data when they are measured; look for queues, load and a slow network"
        if abs(age) > OFFSET_S or age < 0:
            fix = "synchronise the clocks (NTP, chrony), or set use_sim_time on all nodes or none"
        yield error(
            "stamp", role, f"stamps lie {abs(age):.3f} s {side} their arrival", fix
        )


def check_clock(facts: Facts, _: Expected) -> Findings:
    """Checks that `/clock`, if it has a publisher, advances."""
    ends = facts.topics.get(CLOCK)
    heard = facts.heard.get(CLOCK)
    if ends is None or not ends.offers:
        return
    fix = "start the simulation or its clock, or set use_sim_time to false on all nodes"
    if heard is None:
        yield error("clock", CLOCK, "has a publisher but no messages", fix)
        return
    silent = (facts.end_ns - heard.arrivals_ns[-1]) * S_PER_NS
    if silent > STALE_CLOCK_S:
        yield error("clock", CLOCK, f"has been silent for {silent:.1f} s", fix)
    ticks = np.diff(facts.clock_ns)
    if (ticks < 0).any():
        yield error("clock", CLOCK, f"runs backwards {(ticks < 0).sum()} times", fix)
    elif len(ticks) and not ticks.any():
        yield error("clock", CLOCK, "stands still", fix)


def check_motion(facts: Facts, expected: Expected) -> Findings:
    """Checks odometry and commands for NaN, wrong units and wrong signs."""
    yield from _check_odometry(facts, expected.robot)
    if _turns_opposite_to_commands(facts):
        fix = "swap the wheels or invert the sign of angular.z: counter-clockwise is positive"
        yield error("command", CMD_VEL, "the robot turns opposite to its commands", fix)


def check_turning(facts: Facts, expected: Expected) -> Findings:
    """Compares the turns of odometry and gyro, and checks that a gyro is there if needed."""
    if GYRO not in facts.names:
        return
    if GYRO not in facts.heard:
        if expected.gyro:
            what = "the model was made with a gyro, but none publishes"
            fix = "start its driver, or name its topic: --imu TOPIC here, imu:=TOPIC of the nodes"
            yield gyro_warning(what, fix)
        return
    if not facts.yaw_rates:
        yield gyro_warning(
            "reports that it does not measure the yaw rate",
            "choose another topic by --imu",
        )
        return
    turning = _compare_turns(facts)
    if turning is None:
        return
    if turning.mirrored:
        fix = "invert the sign in the driver: the z axis points up, counter-clockwise is positive"
        yield error("gyro", GYRO, "turns opposite to odometry", fix)
    elif turning.in_degrees:
        what = f"turns {1.0 / turning.scale:.3g} times as far as odometry: degrees per second"
        yield error("gyro", GYRO, what, "make the driver send radians per second")
    elif not turning.plausible:
        what = f"does not turn like odometry (correlation {turning.alike:.2f})"
        yield gyro_warning(what, "compare both while the robot turns on the spot")
    elif turning.contradicts and not expected.gyro:
        what = (
            f"contradicts odometry by {turning.apart:.2g} rad in {turning.window_s:g} s: odometry "
            f"turns {turning.scale:.2f} times as far"
        )
        fix = (
            "if wheels slip, trust the gyro: record it and generate the model again, "
            "which then uses it; or give imu:=TOPIC to the nodes, --imu to nics "
            "evaluate"
        )
        yield gyro_warning(what, fix)


def _compare_turns(facts: Facts) -> Turning | None:
    """Compares the turns of odometry and gyro; returns None if the data do not suffice."""
    stamps = facts.heard[ODOM].stamps_ns if ODOM in facts.heard else []
    if not facts.poses or len(stamps) != len(facts.poses):
        return None
    gyro_stamps, yaw_rates = zip(*facts.yaw_rates, strict=True)
    series: list[Array] = []
    for stamps_ns, values in ((stamps, facts.poses), (gyro_stamps, yaw_rates)):
        ns, rows = np.unique(stamps_ns, return_index=True)
        series += [(ns - stamps[0]) * S_PER_NS, np.array(values)[rows]]
    if not all(np.isfinite(column).all() for column in series):
        return None
    odom_t, poses, gyro_t, rates = series
    for window_s in (WINDOW_S, SHORT_WINDOW_S):
        turning = compare_turning(odom_t, poses, gyro_t, rates, window_s)
        if turning is not None and turning.compared:
            return turning
    return None


def _check_odometry(facts: Facts, robot: RobotSpec) -> Findings:
    poses, twists, length = (
        np.array(n) for n in (facts.poses, facts.twists, facts.lengths)
    )
    if not len(poses):
        return
    if not (np.isfinite(poses).all() and np.isfinite(twists).all()):
        yield odometry_error(
            "contains NaN or inf", "find out why its driver sends them"
        )
        return
    off = int((np.abs(length - 1.0) > QUATERNION_TOLERANCE).sum())
    if off:
        what = (
            f"{off} quaternions have a length of up to {length.max():.3g} instead of 1"
        )
        yield odometry_error(
            what, "send a quaternion, not a heading in its z, nor zeros"
        )
        return
    if facts.uncovered:
        what = f"{facts.uncovered} of {len(poses)} messages have a covariance of zeros"
        fix = "fill in pose.covariance and twist.covariance: zeros mean unknown"
        yield odometry_warning(what, fix)
    ends = (robot.command_low, robot.command_high)
    fastest = max(0.1, *(np.hypot(*robot.to_fields(end)[:2]) for end in ends))
    yield from _check_moves(facts, poses, twists, fastest)


def _check_moves(facts: Facts, poses: Array, twists: Array, fastest: float) -> Findings:
    """Finds jumps of poses (T, 3), and compares the rest with the twists (T, 3)."""
    stamps = np.array(facts.heard[ODOM].stamps_ns, dtype=np.int64)
    dt = np.diff(stamps) * S_PER_NS
    is_forward = dt > 0.0
    if is_forward.sum() < LEAST_STEPS:
        return
    step = np.diff(poses[:, :2], axis=0)
    far = np.hypot(step[:, 0], step[:, 1])
    jumps = is_forward & (far > JUMP_M) & (far > JUMP * fastest * dt)
    if jumps.sum() > 0.2 * is_forward.sum():
        speed = float(np.median(far[jumps] / dt[jumps]))
        what = f"positions change by {speed:.0f} per second; the maximum is {fastest:.2g} m/s"
        yield odometry_error(what, "publish positions in metres, not millimetres")
        return
    if jumps.any():
        what = f"jumps {jumps.sum()} times, by up to {far[jumps].max():.2f} m"
        fix = "odom must be continuous (REP-105): corrections belong in map -> odom"
        yield odometry_error(what, fix)
    yield from _check_rates(poses, twists, dt, is_forward & ~jumps)


def _check_rates(
    poses: Array, twists: Array, dt: Array, keep: NDArray[np.bool_]
) -> Findings:
    """Compares the twists with the changes of the poses in the steps (T - 1,) to `keep`."""
    step = np.diff(poses[:, :2], axis=0)
    turn = np.asarray(wrap_angle(np.diff(poses[:, 2])))
    claimed = 0.5 * (twists[1:] + twists[:-1]) * dt[:, None]
    middle = poses[:-1, 2] + 0.5 * turn
    ahead = np.cos(middle) * step[:, 0] + np.sin(middle) * step[:, 1]
    path = np.hypot(step[:, 0], step[:, 1])[keep].sum()
    if path > LEAST_PATH_M or np.abs(claimed[keep, 0]).sum() > 1.0:
        yield from _compare_rates(
            "linear.x", ahead[keep], claimed[keep, 0], UNITS[:3], "m/s"
        )
    if (
        np.abs(turn[keep]).sum() > LEAST_TURN_RAD
        or np.abs(claimed[keep, 2]).sum() > 2.0
    ):
        yield from _compare_rates(
            "angular.z", turn[keep], claimed[keep, 2], UNITS[3:], "rad/s"
        )


def _compare_rates(
    field: str,
    real: Array,
    claimed: Array,
    units: Sequence[tuple[float, str]],
    good: str,
) -> Findings:
    """Compares real displacements (T,) with those that a field of the twist claims (T,).

    A factor between the two that is not about 1 is explained by the sign or one of the `units`.
    """
    power = float(real @ real)
    ratio = float(real @ claimed) / power if power > 0.0 else np.inf
    size = float(np.sqrt(power * (claimed @ claimed)))
    if _is_near_1(ratio):
        return
    if size == 0.0 or abs(real @ claimed) < ALIKE * size:
        fix = (
            "free the robot if it is stuck; otherwise take both from the same odometry"
        )
        yield odometry_warning(f"the pose does not follow twist.{field}", fix)
        return
    what = f"twist.{field} is {ratio:.3g} times the rate of the pose"
    fix = "take both from the same odometry, the twist in the body's frame"
    if _is_near_1(-ratio):
        what = f"twist.{field} has the opposite sign of the rate of the pose"
        fix = "invert the sign: forward and counter-clockwise are positive (REP-103)"
    for factor, name in units:
        if _is_near_1(ratio / factor):
            what = f"{what}: {name}"
            fix = f"publish the twist in {good}"
            break
        if _is_near_1(ratio * factor):
            what = (
                f"the pose changes {1 / ratio:.3g} times as fast as twist.{field} says"
            )
            fix = "publish the pose in metres and radians"
            break
    yield odometry_error(what, fix)


def _is_near_1(ratio: float) -> bool:
    return 1.0 / TOLERANCE < ratio < TOLERANCE


def _turns_opposite_to_commands(facts: Facts) -> bool:
    """True if the turns of odometry and the latest commands are clearly anti-correlated."""
    heard = facts.heard.get(CMD_VEL)
    odometry = facts.heard.get(ODOM)
    if heard is None or odometry is None or len(facts.poses) < LEAST_STEPS:
        return False
    arrivals = odometry.arrivals_ns[:-1]
    place = np.searchsorted(heard.arrivals_ns, arrivals, side="right") - 1
    # A car turns the other way in reverse.
    forward = (place >= 0) & (np.array(facts.twists)[:-1, 0] >= 0.0)
    turn = np.asarray(wrap_angle(np.diff(np.array(facts.poses)[:, 2])))[forward]
    commanded = np.array(facts.commands)[place[forward], 2]
    if np.abs(turn).sum() < LEAST_TURN_RAD or np.abs(commanded).sum() < 1.0:
        return False
    power = (commanded @ commanded) * (turn @ turn)
    return bool(commanded @ turn < -LEAST_ALIKE * np.sqrt(power))


def check_layout(facts: Facts, expected: Expected) -> Findings:
    """Checks the number and directions of the beams, and the limits of their ranges."""
    if len(facts.layouts) > 1:
        counts = ", ".join(map(str, sorted({layout.beams for layout in facts.layouts})))
        fix = "use the driver's mode of fixed angles (such as `angle_compensate`), or resample"
        yield layout_error(f"its header changes; numbers of beams are {counts}", fix)
    for layout in facts.layouts[:1]:
        header = layout.header
        if (
            abs(layout.last - header.angle_max)
            > ANGLE_TOLERANCE * abs(header.angle_increment) + 1e-9
        ):
            end = f"its beams end at {layout.last:.5f} rad"
            what = f"angle_max is {header.angle_max:.5f}, but {end}"
            yield warning("beam layout", SCAN, what, "correct the driver's header")
        if layout.in_degrees:
            what = f"angles go from {header.angle_min:.4g} to {header.angle_max:.4g}: degrees"
            yield error("unit", SCAN, what, "make the driver send radians")
        try:
            if expected.scan is not None:
                doctor_facts.fit_lidar_to_header(layout, expected.lidar, expected.scan)
        except ConfigError as fault:
            fix = "turn or reconfigure the lidar, or train a policy with this view"
            yield layout_error(str(fault), fix)
        else:
            yield from _check_beams(layout, expected)


def _check_beams(layout: doctor_facts.Layout, expected: Expected) -> Findings:
    want = expected.lidar.header
    header = layout.header
    fix = "configure the driver, or describe its scan in a lidar file and generate the model again"
    if layout.beams != expected.lidar.beams:
        yield layout_error(
            f"has {layout.beams} beams, expected {expected.lidar.beams}", fix
        )
    off = max(abs(header.angle_min - want.angle_min), abs(layout.last - want.angle_max))
    if header.angle_increment < 0.0:
        if expected.scan is None and not layout.in_degrees:
            what = "its beams are clockwise (angle_increment is negative)"
            turn = "reverse the order in the driver (`inverted`) to counter-clockwise (REP-103)"
            yield layout_error(what, turn)
    elif not layout.in_degrees and off > ANGLE_TOLERANCE * abs(want.angle_increment):
        wanted = f"{want.angle_min:.4f} to {want.angle_max:.4f}"
        what = f"beams go from {header.angle_min:.4f} to {layout.last:.4f} rad, expected {wanted}"
        yield layout_error(what, fix)
    for key in ("range_min", "range_max"):
        ours = getattr(want, key)
        theirs = getattr(header, key)
        what = f"{key} is {theirs:.4g}, expected {ours:.4g} m"
        if theirs > 100.0 * max(ours, 0.1):
            yield error("unit", SCAN, what, fix)
        elif abs(ours - theirs) > 0.01 * max(abs(ours), 1e-3) + 1e-6:
            yield warning("range limits", SCAN, what, fix)


def check_ranges(facts: Facts, expected: Expected) -> Findings:
    """Checks the lidar's values for no return and the unit of its ranges."""
    if not facts.ranges:
        return
    spec = expected.lidar
    convention = partial(error, "range convention", SCAN)
    values = np.concatenate(facts.ranges).astype(np.float64)
    finite = values[np.isfinite(values) & (values > 0.0)]
    beyond = finite > 1.001 * spec.range_max
    if len(finite) and np.median(finite) > 20.0 * spec.range_max:
        what = f"half of the ranges exceed {np.median(finite):.0f}: millimetres"
        yield error("unit", SCAN, what, "make the driver send metres")
        return
    if len(finite) and beyond.mean() > ODD_FRACTION:
        what = f"{100 * beyond.mean():.0f} % of the ranges exceed range_max {spec.range_max:g} m"
        fix = "set the driver's limit, or range_max of the lidar, and generate the model again"
        yield warning("range convention", SCAN, what, fix)
    hits = {
        "zero": values == 0.0,
        "nan": np.isnan(values),
        "range_max": np.abs(values - spec.range_max) < 1e-4 * spec.range_max,
        "inf": values == np.inf,
    }
    for word, hit in hits.items():
        if hit.mean() > ODD_FRACTION and word != spec.no_return:
            fraction = f"{100 * hit.mean():.0f} % of the ranges are {word}"
            fix = f"set `no_return: {word}` in the lidar and generate the model again"
            yield convention(
                f"{fraction}, but the model expects {spec.no_return} for no return", fix
            )
    if np.isfinite(values[values < 0.0]).any():
        fix = (
            "correct the driver: too close is -inf (REP-117), nothing else is negative"
        )
        yield convention("contains negative ranges", fix)
