"""Arrivals of a topic's data: how old they are, how often they come, and whether their clock runs.

Age is the time since arrival on the steady clock, plus delay. The envelope is the maximum lead of
stamps over that clock, i.e. the lead of the fastest data. Once the gate is armed, the envelope
changes no faster than real clocks drift, so that slowly creeping stamps are not accepted as normal.
"""

import math

from nics_drl_bridge.gate.state import Arrivals, GateConfig, Mark, replace
from nics_drl_bridge.interface import S_PER_NS

# faults of a stamp
REPEATED = "repeated"
JUMPED = "jumped"
# number of remembered stamps; older scans are unknown
KEPT_STAMPS = 64
MARK_S = 0.05  # time between two marks [s]
DRIFT = 1e-3  # maximum drift between two clocks [s/s]; real machines drift by 1e-4
SIMULATED_LAG = 0.2  # fraction of real time that a simulator may lose
# data that lead an armed gate's envelope by more than this are from the future [s]
AHEAD_S = 0.1


def account_for_arrival(
    config: GateConfig,
    arrivals: Arrivals,
    stamp_ns: int,
    now: float,
    gap_s: float,
    armed: bool,
) -> tuple[Arrivals, str]:
    """Returns the arrivals with a new datum, and `repeated`, `jumped` or "".

    After a jump only the new datum is kept.

    Args:
        config: of the gate.
        arrivals: of the earlier data of this topic.
        stamp_ns: of the new datum's header.
        now: its arrival [s].
        gap_s: time between two data that counts as a gap [s].
        armed: the gate is armed, so the envelope may only drift.
    """
    fresh = Arrivals(
        stamps_ns=(stamp_ns,),
        times=(now,),
        late=(0.0,),
        origin=(stamp_ns, now),
        count=1,
        unbroken_s=now,
        marks=((now, stamp_ns, 1, 0.0),),
    )
    if not arrivals.times:
        return fresh, ""
    step = (stamp_ns - arrivals.stamps_ns[-1]) * S_PER_NS
    if step < -config.clock_jump_s:
        return fresh, JUMPED
    if step <= 0.0:
        return arrivals, REPEATED
    first_ns, first_s = arrivals.origin
    lead = (stamp_ns - first_ns) * S_PER_NS / config.clock_rate - (now - first_s)
    if lead - arrivals.envelope > (AHEAD_S if armed else config.clock_jump_s):
        return fresh, JUMPED
    marks = _append_mark(arrivals, stamp_ns, now, lead, config.settle_s)
    passed = now - arrivals.times[-1]
    envelope = max(mark[3] for mark in marks)
    if armed:
        fall = SIMULATED_LAG if config.simulated else DRIFT
        # A longer gap may be a pause of the gate itself, after which queued data are late.
        lowest = arrivals.envelope - fall * min(passed, gap_s)
        envelope = min(max(lead, lowest), arrivals.envelope + DRIFT * passed)
    kept = slice(1 - KEPT_STAMPS, None)
    continued = replace(
        arrivals,
        stamps_ns=(*arrivals.stamps_ns[kept], stamp_ns),
        times=(*arrivals.times[kept], now),
        late=(*arrivals.late[kept], max(0.0, envelope - lead)),
        count=arrivals.count + 1,
        envelope=envelope,
        unbroken_s=now if passed > gap_s else arrivals.unbroken_s,
        marks=marks,
    )
    return continued, ""


def _append_mark(
    arrivals: Arrivals, stamp_ns: int, now: float, lead: float, settle_s: float
) -> tuple[Mark, ...]:
    *before, (time, stamp, number, greatest) = arrivals.marks
    if now - time < MARK_S:
        return (*before, (time, stamp, number, max(lead, greatest)))
    kept = (mark for mark in arrivals.marks if mark[0] >= now - settle_s - 2.0 * MARK_S)
    return (*kept, (now, stamp_ns, arrivals.count + 1, lead))


def reset_envelope(arrivals: Arrivals) -> Arrivals:
    """Returns the arrivals with an envelope computed only from the marks."""
    leads = [mark[3] for mark in arrivals.marks]
    return replace(arrivals, envelope=max(leads, default=arrivals.envelope))


def compute_age(arrivals: Arrivals, now: float) -> float:
    """Returns the age of the newest datum with its delay [s]; inf if there is none."""
    if not arrivals.times:
        return math.inf
    return now - arrivals.times[-1] + arrivals.late[-1]


def measure_rate(
    arrivals: Arrivals, now: float, settle_s: float
) -> tuple[float, float]:
    """Returns the rate by arrival and by stamps over the settling time [Hz]; 0 if unknown."""
    first = next((mark for mark in arrivals.marks if mark[0] >= now - settle_s), None)
    if first is None or arrivals.count <= first[2]:
        return 0.0, 0.0
    count = arrivals.count - first[2]
    passed = arrivals.times[-1] - first[0]
    stamped = (arrivals.stamps_ns[-1] - first[1]) * S_PER_NS
    return (count / passed if passed > 0.0 else math.inf), count / stamped


def measure_creep(arrivals: Arrivals) -> float:
    """Returns the increase of the lead over the steady clock in the later half of the marks [s]."""
    leads = [mark[3] for mark in arrivals.marks]
    half = len(arrivals.marks) // 2
    return max(leads[half:]) - max(leads[:half]) if half else 0.0
