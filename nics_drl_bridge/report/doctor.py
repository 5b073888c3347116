"""What does not fit between a robot as it was heard and what a model expects of it.

Each check is a function of the facts; it yields a finding for each thing that is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.report.doctor_facts import (
    CLOCK,
    CMD_VEL,
    KINDS,
    ODOM,
    SCAN,
    TWIST_STAMPED_TYPE,
    Facts,
)
from nics_drl_bridge.report.doctor_motion import motion, scale

NANO = 1e-9
RATE_TOLERANCE = 0.2
FUTURE_S, LATE_S, OFFSET_S = 0.005, 0.35, 5.0
"""Stamps more than this after their arrival are from the future; before it, too old for the gate of
commands; and so much before it that the clocks must differ."""
STALE_CLOCK_S = 1.0
ANGLE_TOLERANCE = 0.5
"""Of a beam's direction, in increments."""
ODD_SHARE = 0.01
"""A lidar that puts a value on the wire in more than this share of its beams means it."""
BODY_FRAMES = ("base_link", "base_footprint")


@dataclass(frozen=True)
class Finding:
    """Something that does not fit.

    Attributes:
        severity: an `error` makes a policy misbehave; a `warning` may.
        check: what was looked at.
        where: the topic.
        what: what does not fit, with numbers.
        fix: what to do.
    """

    severity: Literal["error", "warning"]
    check: str
    where: str
    what: str
    fix: str


@dataclass(frozen=True)
class Expected:
    """What is expected of a robot, by whatever it was made for.

    Attributes:
        robot: units and limits of state and command.
        lidar: beams, limits, rate, frame and range convention.
        period_s: between commands [s].
    """

    robot: RobotSpec
    lidar: LidarSpec
    period_s: float


def expected_of_model(model: SimulatorModel) -> Expected:
    """What a SimulatorModel expects."""
    return Expected(model.robot, model.lidar, model.control_period)


def examine(facts: Facts, expected: Expected) -> list[Finding]:
    """All findings, errors first."""
    checks = (
        presence, quality, speakers, frames, rates, latency, clock, layout, ranges, motion_of,
    )  # fmt: skip
    found = [finding for check in checks for finding in check(facts, expected)]
    return sorted(found, key=lambda finding: finding.severity)


def presence(facts: Facts, _: Expected) -> Iterator[Finding]:
    """Topics that are missing or silent, and types."""
    for role in (SCAN, ODOM, CMD_VEL):
        name = facts.names[role]
        there = facts.topics.get(name)
        types = () if there is None else there.types
        wrong = [kind for kind in types if kind not in KINDS[role]]
        if wrong or len(types) > 1:
            fix = f"publish {KINDS[role][0]}, or remap the topic that is one"
            yield Finding("error", "type", name, f"is of {' and '.join(types)}", fix)
        elif role == CMD_VEL:
            if facts.live and (there is None or not there.asks):
                fix = "start the base, or correct its namespace or the name of its topic"
                yield Finding("error", "missing topic", name, "nobody listens to it", fix)
        elif role not in facts.heard:
            what = "there is no such topic" if there is None else "nothing was heard on it"
            near = [topic for topic, ends in facts.topics.items() if KINDS[role][0] in ends.types]
            hint = f"; {', '.join(near)} is of its type: remap it" if near and not there else ""
            fix = f"start its driver, or correct namespace or ROS_DOMAIN_ID{hint}"
            yield Finding("error", "missing topic", name, what, fix)
        if TWIST_STAMPED_TYPE in types and not facts.live:
            fix = "set `enable_stamped_cmd_vel` where the package's nodes are to take it"
            yield Finding("warning", "type", name, "is a TwistStamped, not a Twist", fix)


def quality(facts: Facts, _: Expected) -> Iterator[Finding]:
    """Pairs of publisher and subscriber that never match."""
    for role, name in facts.names.items():
        there = facts.topics.get(name)
        if there is None:
            continue
        weak = any(not offer.reliable for offer in there.offers)
        if role != CLOCK and weak and any(ask.reliable for ask in there.asks):
            fix = "let the publisher be reliable, or the subscriber best effort"
            what = "is sent best effort, and a subscriber asks for reliable: they never match"
            yield Finding("error", "quality of service", name, what, fix)
        passing = any(not offer.transient_local for offer in there.offers)
        if passing and any(ask.transient_local for ask in there.asks):
            fix = "let both be volatile"
            what = "is sent volatile, and a subscriber asks for transient local: they never match"
            yield Finding("error", "quality of service", name, what, fix)


def speakers(facts: Facts, _: Expected) -> Iterator[Finding]:
    """Several publishers of what must come from one."""
    for role in (CMD_VEL, ODOM, SCAN, CLOCK):
        there = facts.topics.get(facts.names[role])
        if there is not None and len(there.offers) > 1:
            what = f"has {len(there.offers)} publishers, which overrule each other"
            fix = "end all but one: joystick, navigation, a second simulator"
            yield Finding("error", "publishers", facts.names[role], what, fix)


def frames(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """Names of frames, by REP-105 and by the lidar's."""
    wanted = (
        (SCAN, "frames", (expected.lidar.frame,), "header.frame_id"),
        (ODOM, "frames", ("odom",), "header.frame_id"),
        (ODOM, "children", BODY_FRAMES, "child_frame_id"),
    )
    for role, attribute, good, place in wanted:
        heard = facts.heard.get(role)
        if heard is None:
            continue
        for frame in sorted(getattr(heard, attribute)):
            if frame.rpartition("/")[2] in good and not frame.startswith("/"):
                continue  # a prefix is how robots of a fleet keep apart
            if role == SCAN and frame not in ("", "map", "odom", *BODY_FRAMES):
                fix = f"call it {good[0]!r} in the driver, or set `frame: {frame}` in the lidar"
            else:
                fix = f"call it {good[0]!r} (REP-105), without a leading slash"
            severity: Literal["error", "warning"] = "error" if role == ODOM else "warning"
            yield Finding(
                severity, "frame", facts.names[role], f"{place} is {frame!r}, not {good[0]!r}", fix
            )


def rates(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """Rates as declared: that of the lidar, and odometry at least once a command."""
    for role, wanted, exactly in (
        (SCAN, expected.lidar.rate, True),
        (ODOM, 1.0 / expected.period_s, False),
    ):
        rate = _rate(facts, role)
        if rate is None:
            continue
        slow, fast = rate < (1 - RATE_TOLERANCE) * wanted, rate > (1 + RATE_TOLERANCE) * wanted
        if slow or (fast and exactly):
            least = "" if exactly else "at least "
            fix = "set the driver's rate; on a slow network look for losses (best effort, Wi-Fi)"
            if role == SCAN:
                fix += f", or set `rate: {rate:.3g}` in the lidar and generate the model anew"
            what = f"comes at {rate:.3g} Hz, expected {least}{wanted:.3g} Hz"
            yield Finding("error" if slow else "warning", "rate", facts.names[role], what, fix)


def _rate(facts: Facts, role: str) -> float | None:
    """By the stamps where there are some: a simulation may run at another speed."""
    heard = facts.heard.get(role)
    if heard is None:
        return None
    stamps = np.array(heard.stamps_ns, dtype=np.int64)
    if facts.clock_ns and len(stamps) > 2 and stamps[-1] > stamps[0]:
        return float((len(stamps) - 1) / ((stamps[-1] - stamps[0]) * NANO))
    return heard.rate_hz


def latency(facts: Facts, _: Expected) -> Iterator[Finding]:
    """Arrival minus stamp, by `/clock` where there is one."""
    for role in (SCAN, ODOM):
        heard = facts.heard.get(role)
        if heard is None:
            continue
        name, stamps = facts.names[role], np.array(heard.stamps_ns, dtype=np.int64)
        if (stamps == 0).any():
            what = f"{(stamps == 0).sum()} of {len(stamps)} messages are not stamped"
            yield Finding("error", "stamp", name, what, "let the driver stamp its messages")
            continue
        if (np.diff(stamps) < 0).any():
            what = f"{(np.diff(stamps) < 0).sum()} stamps are before the one before them"
            fix = "look for a second publisher, or for a clock that is set while it runs"
            yield Finding("error", "stamp", name, what, fix)
        age = float(np.median(_here(facts, heard.arrivals_ns) - stamps)) * NANO
        if -FUTURE_S <= age <= LATE_S:
            continue
        side = "after" if age < 0 else "before"
        what = f"stamps lie {abs(age):.3f} s {side} their arrival"
        if abs(age) > OFFSET_S or age < 0:
            fix = "synchronise the clocks (NTP, chrony), or set use_sim_time on all nodes or none"
        else:
            fix = "stamp when it is measured, and look for queues, load and network on the way"
        yield Finding("error", "stamp", name, what, fix)


def _here(facts: Facts, arrivals: Sequence[int]) -> NDArray[np.int64]:
    """Arrivals (T,) on the clock that stamps should be of [ns]."""
    times = np.array(arrivals, dtype=np.int64)
    if not facts.clock_ns:
        return times
    ticks = np.array(facts.heard[CLOCK].arrivals_ns, dtype=np.int64)
    # The tick of a datum is sent with it, and may come in after it.
    place = np.searchsorted(ticks, times, side="right").clip(0, len(ticks) - 1)
    return np.asarray(np.array(facts.clock_ns, dtype=np.int64)[place])


def clock(facts: Facts, _: Expected) -> Iterator[Finding]:
    """Whether `/clock`, where somebody publishes it, goes on."""
    there = facts.topics.get(CLOCK)
    if there is None or not there.offers:
        return
    fix = "start the simulation or its clock, or set use_sim_time to false on all nodes"
    heard = facts.heard.get(CLOCK)
    if heard is None:
        yield Finding("error", "clock", CLOCK, "has a publisher and says nothing", fix)
        return
    silent = (facts.end_ns - heard.arrivals_ns[-1]) * NANO
    if silent > STALE_CLOCK_S:
        yield Finding("error", "clock", CLOCK, f"has been silent for {silent:.1f} s", fix)
    ticks = np.diff(facts.clock_ns)
    if (ticks < 0).any():
        yield Finding("error", "clock", CLOCK, f"runs backwards {(ticks < 0).sum()} times", fix)
    elif len(ticks) and not ticks.any():
        yield Finding("error", "clock", CLOCK, "stands still", fix)


def layout(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """Number and directions of the beams, and limits of their ranges."""
    name, want = facts.names[SCAN], expected.lidar.header
    if len(facts.layouts) > 1:
        counts = sorted({one.beams for one in facts.layouts})
        what = f"its header changes; numbers of beams are {', '.join(map(str, counts))}"
        fix = "use the driver's mode of fixed angles (as `angle_compensate`), or resample"
        yield Finding("error", "beam layout", name, what, fix)
    for have in facts.layouts[:1]:
        fix = "set the driver, or make a lidar file of what it sends and generate the model anew"
        if have.beams != expected.lidar.beams:
            what = f"has {have.beams} beams, expected {expected.lidar.beams}"
            yield Finding("error", "beam layout", name, what, fix)
        last = have.angle_min + (have.beams - 1) * have.angle_increment
        step = abs(want.angle_increment)
        if abs(last - have.angle_max) > ANGLE_TOLERANCE * max(abs(have.angle_increment), 1e-9):
            what = f"angle_max is {have.angle_max:.5f}, but its beams end at {last:.5f} rad"
            yield Finding("warning", "beam layout", name, what, "correct the driver's header")
        if max(abs(have.angle_min), abs(have.angle_max)) > 7.0:
            what = f"angles go from {have.angle_min:.4g} to {have.angle_max:.4g}: degrees"
            yield Finding("error", "unit", name, what, "let the driver send radians")
        elif have.angle_increment < 0.0:
            what = "its beams go clockwise (angle_increment is negative)"
            fix = "turn the order in the driver (`inverted`): beams go counter-clockwise (REP-103)"
            yield Finding("error", "beam layout", name, what, fix)
        elif (
            abs(have.angle_min - want.angle_min) > ANGLE_TOLERANCE * step
            or abs(last - want.angle_max) > ANGLE_TOLERANCE * step
        ):
            what = (
                f"beams go from {have.angle_min:.4f} to {last:.4f} rad, expected "
                f"{want.angle_min:.4f} to {want.angle_max:.4f}"
            )
            yield Finding("error", "beam layout", name, what, fix)
        for key in ("range_min", "range_max"):
            ours, theirs = getattr(want, key), getattr(have, key)
            if abs(ours - theirs) > 0.01 * max(abs(ours), 1e-3) + 1e-6:
                big = theirs > 100.0 * max(ours, 0.1)
                what = f"{key} is {theirs:.4g}, expected {ours:.4g} m"
                kind = "unit" if big else "range limits"
                yield Finding("error" if big else "warning", kind, name, what, fix)


def ranges(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """What the lidar puts on the wire where nothing came back, and its unit."""
    if not facts.ranges:
        return
    spec, name = expected.lidar, facts.names[SCAN]
    values = np.concatenate(facts.ranges).astype(np.float64)
    finite = values[np.isfinite(values) & (values > 0.0)]
    beyond = finite > 1.001 * spec.range_max
    if len(finite) and np.median(finite) > 20.0 * spec.range_max:
        what = f"half of the ranges exceed {np.median(finite):.0f}: millimetres"
        yield Finding("error", "unit", name, what, "let the driver send metres")
        return
    if len(finite) and beyond.mean() > ODD_SHARE:
        what = f"{100 * beyond.mean():.0f} % of the ranges exceed range_max {spec.range_max:g} m"
        fix = "set the driver's limit, or range_max of the lidar, and generate the model anew"
        yield Finding("warning", "range convention", name, what, fix)
    at_max = np.abs(values - spec.range_max) < 1e-4 * spec.range_max
    for word, hit in (
        ("zero", values == 0.0),
        ("nan", np.isnan(values)),
        ("range_max", at_max),
        ("inf", values == np.inf),
    ):
        if hit.mean() > ODD_SHARE and word != spec.no_return:
            what = (
                f"{100 * hit.mean():.0f} % of the ranges are {word}, but no return is expected "
                f"as {spec.no_return}"
            )
            fix = f"set `no_return: {word}` in the lidar and generate the model anew"
            yield Finding("error", "range convention", name, what, fix)
    if (values < 0.0).any() and np.isfinite(values[values < 0.0]).any():
        fix = "correct the driver: too close is -inf (REP-117), nothing else is negative"
        yield Finding("error", "range convention", name, "holds negative ranges", fix)


def motion_of(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """Odometry and commands: numbers, units and signs."""
    name = facts.names[ODOM]
    for what, fix, severe in motion(facts, expected.robot):
        yield Finding("error" if severe else "warning", "odometry", name, what, fix)
    ratio = scale(facts)
    if ratio is not None and ratio < 0.0:
        what = "the robot turns against its commands"
        fix = "swap the wheels or turn the sign of angular.z: counter-clockwise is positive"
        yield Finding("error", "command", facts.names[CMD_VEL], what, fix)
