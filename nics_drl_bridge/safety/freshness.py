"""Age of data: by arrival on the steady clock, and by how late they came.

How far a stamp is ahead of the steady clock tells the offset of the two clocks, less the time that
the datum took; the greatest such lead, the envelope, that of the fastest data (the idea of one-way
delay estimation by the lower envelope). It is found before the gate is armed, and fixed from then
on: it follows at most the drift of real clocks. So stamps that creep ahead, or fall behind, become
neither the new present nor the new normal.
"""

from __future__ import annotations

from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.safety.records import replace
from nics_drl_bridge.safety.state import Arrivals, Cause, GateConfig, GateState, Mark

SCAN, ODOM = "scan", "odom"
KEPT = 64
"""Data whose stamps are known; a command on the scan before those is on an unknown one."""
MARK_S = 0.05
"""Between two marks."""
DRIFT = 1e-3
"""Seconds per second by which two clocks may drift apart; those of real machines do by 1e-4."""
SIMULATED_LAG = 0.2
"""The share of real time that a simulator may lose."""
AHEAD_S = 0.1
"""Data of an armed gate that are so much faster than the fastest before it are from the future."""


def arrived(
    config: GateConfig, arrivals: Arrivals, stamp_ns: int, now: float, gap_s: float, armed: bool
) -> tuple[Arrivals, str]:
    """Takes a datum into account, or says why not.

    Args:
        config: of the gate.
        arrivals: so far.
        stamp_ns: of the datum [ns].
        now: steady time [s].
        gap_s: the longest gap between two of them [s].
        armed: whether the envelope is fixed.

    Returns:
        The arrivals, and `repeated`, `jumped` or nothing. After a jump only the new datum counts.
    """
    fresh = Arrivals(
        (stamp_ns,), (now,), (0.0,), (stamp_ns, now), 1, 0.0, now, ((now, stamp_ns, 1, 0.0),)
    )
    if not arrivals.times:
        return fresh, ""
    step = (stamp_ns - arrivals.stamps_ns[-1]) * S_PER_NS
    if step < -config.clock_jump_s:
        return fresh, "jumped"
    if step <= 0.0:
        return arrivals, "repeated"
    lead = _lead(config, arrivals, stamp_ns, now)
    if lead - arrivals.envelope > (AHEAD_S if armed else config.clock_jump_s):
        return fresh, "jumped"
    marks = _marked(arrivals, stamp_ns, now, lead, config.settle_s)
    if armed:
        passed = now - arrivals.times[-1]
        fall = SIMULATED_LAG if config.simulated else DRIFT
        lowest, highest = arrivals.envelope - fall * passed, arrivals.envelope + DRIFT * passed
        envelope = min(max(lead, lowest), highest)
    else:
        envelope = max(mark[3] for mark in marks)
    return replace(
        arrivals,
        stamps_ns=(*arrivals.stamps_ns[1 - KEPT :], stamp_ns),
        times=(*arrivals.times[1 - KEPT :], now),
        late=(*arrivals.late[1 - KEPT :], max(0.0, envelope - lead)),
        count=arrivals.count + 1,
        envelope=envelope,
        unbroken_s=now if now - arrivals.times[-1] > gap_s else arrivals.unbroken_s,
        marks=marks,
    ), ""


def _lead(config: GateConfig, arrivals: Arrivals, stamp_ns: int, now: float) -> float:
    first_ns, first_s = arrivals.origin
    return (stamp_ns - first_ns) * S_PER_NS / config.clock_rate - (now - first_s)


def _marked(
    arrivals: Arrivals, stamp_ns: int, now: float, lead: float, settle_s: float
) -> tuple[Mark, ...]:
    """The marks, with a datum in the last of them or one of its own."""
    *before, (time, stamp, number, greatest) = arrivals.marks
    if now - time < MARK_S:
        if lead <= greatest:
            return arrivals.marks
        return (*before, (time, stamp, number, lead))
    oldest = now - settle_s - 2.0 * MARK_S
    kept = (mark for mark in arrivals.marks if mark[0] >= oldest)
    return (*kept, (now, stamp_ns, arrivals.count + 1, lead))


def settled(arrivals: Arrivals) -> Arrivals:
    """With the envelope of the data of the last time, whatever it was before."""
    if not arrivals.marks:
        return arrivals
    return replace(arrivals, envelope=max(mark[3] for mark in arrivals.marks))


def age(arrivals: Arrivals, now: float, index: int = -1) -> float:
    """Seconds since a datum (the newest) was as new as can be; inf when there is none."""
    if not arrivals.times:
        return float("inf")
    return now - arrivals.times[index] + arrivals.late[index]


def _silence(rule: str, topic: str, arrivals: Arrivals, now: float, limit: float) -> Cause | None:
    old = age(arrivals, now)
    return Cause(rule, topic, "no fresh data", old, limit) if not old <= limit else None


def scan_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The lidar has stopped."""
    return _silence("scan_silent", SCAN, state.scans, now, config.scan_age_s)


def odom_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Odometry has stopped."""
    return _silence("odom_silent", ODOM, state.odometries, now, config.odom_age_s)


def stamps_jumped(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """A sensor's clock has jumped or runs ahead: its stamps lie in the future, or far back."""
    if not state.jumped:
        return None
    return Cause("stamps_jumped", state.jumped, "its stamps have jumped, or run ahead of time")


def gap_free(arrivals: Arrivals, now: float, settle_s: float, limit: float) -> bool:
    """Whether data have come for a time without a gap longer than a limit."""
    if not arrivals.times:
        return False
    return now - arrivals.unbroken_s >= settle_s and now - arrivals.times[-1] <= limit


def rate(arrivals: Arrivals, now: float, settle_s: float) -> tuple[float, float]:
    """Data per second by arrival, and by their stamps, over the last time; 0 when unknown."""
    first = next((mark for mark in arrivals.marks if mark[0] >= now - settle_s), None)
    if first is None or arrivals.count <= first[2]:
        return 0.0, 0.0
    count = arrivals.count - first[2]
    passed = arrivals.times[-1] - first[0]
    stamped = (arrivals.stamps_ns[-1] - first[1]) * S_PER_NS
    return (count / passed if passed > 0.0 else float("inf")), count / stamped


def creep(arrivals: Arrivals) -> float:
    """How much further ahead of the steady clock the later half of the marks is [s]."""
    half = len(arrivals.marks) // 2
    if half == 0:
        return 0.0
    early, late = arrivals.marks[:half], arrivals.marks[half:]
    return max(mark[3] for mark in late) - max(mark[3] for mark in early)
