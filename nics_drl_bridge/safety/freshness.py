"""Age of data: by arrival on the steady clock, and by how late they came."""

from __future__ import annotations

from itertools import pairwise

from nics_drl_bridge.safety.state import Arrivals, Cause, GateConfig, GateState

SCAN, ODOM = "scan", "odom"
KEPT = 400
JUDGED = 20
"""Arrivals that tell how fast a topic's data come at best."""
NANO = 1e-9


def arrived(arrivals: Arrivals, stamp_ns: int, now: float, jump_s: float) -> tuple[Arrivals, str]:
    """Takes a datum into account, or says why not.

    Its lateness is how much longer it took than the fastest of the last ones: the offset between
    two clocks and the least transport time drop out, and a stamp is compared with nothing but the
    steady clock. (The idea of one-way delay estimation by the lower envelope.)

    Args:
        arrivals: so far.
        stamp_ns: of the datum [ns].
        now: steady time [s].
        jump_s: a stamp so far ahead of the steady clock, or back, is a jump [s].

    Returns:
        The arrivals, and `repeated`, `jumped` or nothing. After a jump only the new datum counts.
    """
    fresh = Arrivals((stamp_ns,), (now,), (0.0,))
    if not arrivals.times:
        return fresh, ""
    step = (stamp_ns - arrivals.stamps_ns[-1]) * NANO
    if step < -jump_s:
        return fresh, "jumped"
    if step <= 0.0:
        return arrivals, "repeated"
    late = max(
        (stamp - stamp_ns) * NANO - (time - now)
        for stamp, time in zip(arrivals.stamps_ns[-JUDGED:], arrivals.times[-JUDGED:], strict=True)
    )
    if late < -jump_s:
        return fresh, "jumped"
    return Arrivals(
        (*arrivals.stamps_ns[-KEPT:], stamp_ns),
        (*arrivals.times[-KEPT:], now),
        (*arrivals.late[-KEPT:], max(0.0, late)),
    ), ""


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
    """A sensor's clock has jumped: its stamps lie in the future, or far back."""
    if not state.jumped:
        return None
    return Cause("stamps_jumped", state.jumped, "its stamps have jumped")


def gap_free(arrivals: Arrivals, now: float, settle_s: float, limit: float) -> bool:
    """Whether data have come for a time without a gap longer than a limit."""
    times = [time for time in arrivals.times if time <= now]
    if not times or now - times[0] < settle_s:
        return False
    recent = [*(time for time in times if time > now - settle_s - limit), now]
    gaps = [b - a for a, b in pairwise(recent)]
    return bool(gaps) and recent[0] <= now - settle_s + limit and max(gaps) <= limit


def rate(arrivals: Arrivals, now: float, settle_s: float) -> tuple[float, float]:
    """Data per second by arrival, and by their stamps, over the last time; 0 when unknown."""
    first = next((i for i, time in enumerate(arrivals.times) if time >= now - settle_s), None)
    if first is None or len(arrivals.times) - first < 2:
        return 0.0, 0.0
    count = len(arrivals.times) - 1 - first
    passed = arrivals.times[-1] - arrivals.times[first]
    stamped = (arrivals.stamps_ns[-1] - arrivals.stamps_ns[first]) * NANO
    return (count / passed if passed > 0.0 else float("inf")), count / stamped
