"""Checks of the data received from a robot against the expectations of a model.

Each check is a function of the facts; it yields a finding for each fault.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.report.doctor_checks import layout, motion, ranges, scale
from nics_drl_bridge.report.doctor_facts import (
    CLOCK,
    CMD_VEL,
    KINDS,
    ODOM,
    SCAN,
    TWIST_STAMPED_TYPE,
    Expected,
    Facts,
    Mismatch,
    seen,
)

RATE_TOLERANCE = 0.2
FUTURE_S, LATE_S, OFFSET_S = 0.005, 0.35, 5.0
"""Stamps are from the future if this much after their arrival; too old for the command gate if this
much before it; and so far before it that the clocks must differ."""
STALE_CLOCK_S = 1.0
BODY_FRAMES = ("base_link", "base_footprint")


def examine(facts: Facts, expected: Expected) -> list[Mismatch]:
    """Runs all checks and returns their findings, errors first."""
    expected = seen(facts, expected)
    checks = (
        presence, quality, speakers, frames, rates, latency, clock, layout, ranges, motion_of,
    )  # fmt: skip
    found = [finding for check in checks for finding in check(facts, expected)]
    return sorted(found, key=lambda finding: finding.severity)


def presence(facts: Facts, _: Expected) -> Iterator[Mismatch]:
    """Finds missing and silent topics, and wrong types."""
    for role in (SCAN, ODOM, CMD_VEL):
        name = facts.names[role]
        there = facts.topics.get(name)
        types = () if there is None else there.types
        wrong = [kind for kind in types if kind not in KINDS[role]]
        if wrong or len(types) > 1:
            fix = f"publish {KINDS[role][0]}, or remap the topic that is one"
            yield Mismatch("error", "type", name, f"is of {' and '.join(types)}", fix)
        elif role == CMD_VEL:
            if facts.live and (there is None or not there.asks):
                fix = "start the base, or correct its namespace or the name of its topic"
                yield Mismatch("error", "missing topic", name, "nobody listens to it", fix)
        elif role not in facts.heard:
            what = "there is no such topic" if there is None else "nothing was heard on it"
            near = [topic for topic, ends in facts.topics.items() if KINDS[role][0] in ends.types]
            hint = f"; {', '.join(near)} is of its type: remap it" if near and not there else ""
            fix = f"start its driver, or correct namespace or ROS_DOMAIN_ID{hint}"
            yield Mismatch("error", "missing topic", name, what, fix)
        if TWIST_STAMPED_TYPE in types and not facts.live:
            fix = "set `enable_stamped_cmd_vel` where the package's nodes are to take it"
            yield Mismatch("warning", "type", name, "is a TwistStamped, not a Twist", fix)


def quality(facts: Facts, _: Expected) -> Iterator[Mismatch]:
    """Finds pairs of publisher and subscriber with incompatible quality of service."""
    for role, name in facts.names.items():
        there = facts.topics.get(name)
        if there is None:
            continue
        weak = any(not offer.reliable for offer in there.offers)
        if role != CLOCK and weak and any(ask.reliable for ask in there.asks):
            fix = "let the publisher be reliable, or the subscriber best effort"
            what = "is sent best effort, and a subscriber asks for reliable: they never match"
            yield Mismatch("error", "quality of service", name, what, fix)
        passing = any(not offer.transient_local for offer in there.offers)
        if passing and any(ask.transient_local for ask in there.asks):
            fix = "let both be volatile"
            what = "is sent volatile, and a subscriber asks for transient local: they never match"
            yield Mismatch("error", "quality of service", name, what, fix)


def speakers(facts: Facts, _: Expected) -> Iterator[Mismatch]:
    """Finds several publishers on topics that must have a single one."""
    for role in (CMD_VEL, ODOM, SCAN, CLOCK):
        there = facts.topics.get(facts.names[role])
        if there is not None and len(there.offers) > 1:
            what = f"has {len(there.offers)} publishers, which overrule each other"
            fix = "end all but one: joystick, navigation, a second simulator"
            yield Mismatch("error", "publishers", facts.names[role], what, fix)


def frames(facts: Facts, expected: Expected) -> Iterator[Mismatch]:
    """Checks names of frames against REP-105 and the lidar's frame."""
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
                continue  # robots of a fleet have prefixes
            if role == SCAN and frame not in ("", "map", "odom", *BODY_FRAMES):
                fix = f"call it {good[0]!r} in the driver, or set `frame: {frame}` in the lidar"
            else:
                fix = f"call it {good[0]!r} (REP-105), without a leading slash"
            severity: Literal["error", "warning"] = "error" if role == ODOM else "warning"
            yield Mismatch(
                severity, "frame", facts.names[role], f"{place} is {frame!r}, not {good[0]!r}", fix
            )


def rates(facts: Facts, expected: Expected) -> Iterator[Mismatch]:
    """Checks rates: the scan's as declared, odometry at least one message per command."""
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
            yield Mismatch("error" if slow else "warning", "rate", facts.names[role], what, fix)


def _rate(facts: Facts, role: str) -> float | None:
    """Rate by the stamps if there is a `/clock`: a simulation may run at another speed."""
    heard = facts.heard.get(role)
    if heard is None:
        return None
    stamps = np.array(heard.stamps_ns, dtype=np.int64)
    if facts.clock_ns and len(stamps) > 2 and stamps[-1] > stamps[0]:
        return float((len(stamps) - 1) / ((stamps[-1] - stamps[0]) * S_PER_NS))
    return heard.rate_hz


def latency(facts: Facts, _: Expected) -> Iterator[Mismatch]:
    """Checks arrival minus stamp, by `/clock` if there is one."""
    for role in (SCAN, ODOM):
        heard = facts.heard.get(role)
        if heard is None:
            continue
        name, stamps = facts.names[role], np.array(heard.stamps_ns, dtype=np.int64)
        if (stamps == 0).any():
            what = f"{(stamps == 0).sum()} of {len(stamps)} messages are not stamped"
            yield Mismatch("error", "stamp", name, what, "let the driver stamp its messages")
            continue
        if (np.diff(stamps) < 0).any():
            what = f"{(np.diff(stamps) < 0).sum()} stamps are before the one before them"
            fix = "look for a second publisher, or for a clock that is set while it runs"
            yield Mismatch("error", "stamp", name, what, fix)
        age = float(np.median(_here(facts, heard.arrivals_ns) - stamps)) * S_PER_NS
        if -FUTURE_S <= age <= LATE_S:
            continue
        side = "after" if age < 0 else "before"
        what = f"stamps lie {abs(age):.3f} s {side} their arrival"
        if abs(age) > OFFSET_S or age < 0:
            fix = "synchronise the clocks (NTP, chrony), or set use_sim_time on all nodes or none"
        else:
            fix = "stamp when it is measured, and look for queues, load and network on the way"
        yield Mismatch("error", "stamp", name, what, fix)


def _here(facts: Facts, arrivals: Sequence[int]) -> NDArray[np.int64]:
    """Arrivals (T,) on the clock that the stamps should use [ns]."""
    times = np.array(arrivals, dtype=np.int64)
    if not facts.clock_ns:
        return times
    ticks = np.array(facts.heard[CLOCK].arrivals_ns, dtype=np.int64)
    # The tick of a message is sent with it, and may arrive after it.
    place = np.searchsorted(ticks, times, side="right").clip(0, len(ticks) - 1)
    return np.asarray(np.array(facts.clock_ns, dtype=np.int64)[place])


def clock(facts: Facts, _: Expected) -> Iterator[Mismatch]:
    """Checks that `/clock`, if it has a publisher, advances."""
    there = facts.topics.get(CLOCK)
    if there is None or not there.offers:
        return
    fix = "start the simulation or its clock, or set use_sim_time to false on all nodes"
    heard = facts.heard.get(CLOCK)
    if heard is None:
        yield Mismatch("error", "clock", CLOCK, "has a publisher and says nothing", fix)
        return
    silent = (facts.end_ns - heard.arrivals_ns[-1]) * S_PER_NS
    if silent > STALE_CLOCK_S:
        yield Mismatch("error", "clock", CLOCK, f"has been silent for {silent:.1f} s", fix)
    ticks = np.diff(facts.clock_ns)
    if (ticks < 0).any():
        yield Mismatch("error", "clock", CLOCK, f"runs backwards {(ticks < 0).sum()} times", fix)
    elif len(ticks) and not ticks.any():
        yield Mismatch("error", "clock", CLOCK, "stands still", fix)


def motion_of(facts: Facts, expected: Expected) -> Iterator[Mismatch]:
    """Checks odometry and commands: numbers, units and signs."""
    name = facts.names[ODOM]
    for what, fix, severe in motion(facts, expected.robot):
        yield Mismatch("error" if severe else "warning", "odometry", name, what, fix)
    ratio = scale(facts)
    if ratio is not None and ratio < 0.0:
        what = "the robot turns against its commands"
        fix = "swap the wheels or turn the sign of angular.z: counter-clockwise is positive"
        yield Mismatch("error", "command", facts.names[CMD_VEL], what, fix)
