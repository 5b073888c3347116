"""Rules that stop the robot by the age of data, the gate's own clock, commands and e-stop."""
# Age is the time since arrival on the steady clock, plus delay. The envelope is the
# maximum lead of stamps over that clock, i.e. the lead of the fastest data. Once the
# gate is armed, the envelope changes no faster than real clocks drift, so that slowly
# creeping stamps are not accepted as normal.

import math

from nics_drl_bridge.gate.inputs import E_STOP, RAW, Command, Input, Tick
from nics_drl_bridge.gate.state import (
    Arrivals,
    Cause,
    GateConfig,
    GateState,
    Mark,
    replace,
)
from nics_drl_bridge.interface import S_PER_NS
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

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
SOURCE_S = 1.0  # time after which a command of another publisher is accepted [s]
# a running clock never gives this many consecutive inputs the same time
FROZEN_INPUTS = 20


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
        envelope=0.0,
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
        # A longer gap may be a pause of the gate itself, after which queued data are
        # late.
        lowest = arrivals.envelope - fall * min(passed, gap_s)
        highest = arrivals.envelope + DRIFT * passed
        envelope = min(max(lead, lowest), highest)
    kept = slice(1 - KEPT_STAMPS, None)
    continued = Arrivals(
        stamps_ns=(*arrivals.stamps_ns[kept], stamp_ns),
        times=(*arrivals.times[kept], now),
        late=(*arrivals.late[kept], max(0.0, envelope - lead)),
        origin=arrivals.origin,
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


def _judge_age(
    rule: str, topic: str, detail: str, age: float, limit: float
) -> Cause | None:
    """Returns the cause of a stop if an age is beyond its limit [s], or NaN."""
    return None if age <= limit else Cause(rule, topic, detail, age, limit)


def make_cause(rule: str, topic: str, detail: str) -> Cause | None:
    """Returns the cause of a stop; None if there is no detail."""
    return Cause(rule, topic, detail) if detail else None


def scan_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The newest scan is too old: the lidar has stopped."""
    return _judge_age(
        "scan_silent",
        SCAN,
        "no fresh data",
        compute_age(state.scans, now),
        config.scan_age_s,
    )


def sensor_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The newest reading of an additional sensor is too old: it has stopped."""
    ages = [
        (compute_age(sensor.arrivals, now), name)
        for name, sensor in zip(config.sensors, state.sensors, strict=True)
    ]
    age, name = max(ages, default=(0.0, ""))
    return _judge_age("sensor_silent", name, "no fresh data", age, config.scan_age_s)


def odom_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The newest odometry is too old: it has stopped."""
    age = compute_age(state.odometries, now)
    return _judge_age("odom_silent", ODOM, "no fresh data", age, config.odom_age_s)


def stamps_jumped(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """A sensor's clock has jumped or runs ahead: its stamps lie in the future, or far back."""
    if not state.jumped:
        return None
    detail = "its stamps have jumped, or run ahead of time"
    return Cause("stamps_jumped", state.jumped, detail)


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


def take_time(
    config: GateConfig, state: GateState, event: Input, now: float
) -> GateState:
    """Records the time of an input, and any fault of the clock."""
    if not math.isfinite(now) or now < state.now_s:
        return replace(
            state, clock_fault=f"the steady clock went from {state.now_s} to {now} s"
        )
    still = state.still_ticks + 1 if now == state.now_s else 0
    fault = ""
    if still >= FROZEN_INPUTS:
        fault = f"the steady clock stands still at {now} s"
    ticked = state.tick_s
    awake = state.awake_s
    if ticked is not None and now - ticked > config.gap_s:
        # Any input may wake the gate up.
        fault = f"no decision for {now - ticked:.3f} s, the limit is {config.gap_s} s"
        awake = now
    elif now - awake <= config.gap_s:
        # A single zero may be lost, because only the newest command counts.
        fault = f"awake again for only {now - awake:.3f} s"
    return replace(
        state,
        now_s=now,
        tick_s=now if isinstance(event, Tick) else ticked,
        awake_s=awake,
        still_ticks=still,
        clock_fault=fault,
    )


def own_clock(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The gate's clock can't be trusted, or the gate was asleep."""
    return make_cause("own_clock", "", state.clock_fault)


def watch_source(state: GateState, command: Command, now: float) -> GateState:
    """Records the publisher of a command, and whether another one was recently active."""
    mixed = ""
    if command.publishers > 1:
        mixed = f"{command.publishers} nodes publish on {RAW}"
    if command.source:
        recent = now - state.source_s < SOURCE_S
        if recent and state.source != command.source:
            mixed = f"{state.source} and {command.source} both publish on {RAW}"
        state = replace(state, source=command.source, source_s=now)
    if not mixed:
        return state
    mixed = f"{mixed}: leave one of them, then call ~/reset and ~/arm"
    return replace(state, mixed=mixed, last_mixed=mixed, mixed_s=now)


def two_policies(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """Two publishers command the robot alternately."""
    return make_cause("two_policies", RAW, state.mixed)


def command_malformed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The newest command is malformed."""
    return make_cause("command_malformed", RAW, state.malformed)


def command_missing(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """No command has arrived yet."""
    if state.command is not None or state.pending is not None:
        return None
    return Cause("command_missing", RAW, "no command yet")


def command_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The policy has stopped, or hangs."""
    if state.command is None:
        return None
    age = now - state.command_s
    return _judge_age(
        "command_silent", RAW, "no fresh command", age, config.command_age_s
    )


def scan_behind_unknown(
    config: GateConfig, state: GateState, now: float
) -> Cause | None:
    """Commands name scans that do not arrive, perhaps from the future. One may be in transit."""
    if state.pending is None or state.pending_s is None:
        return None
    if now - state.pending_s <= config.race_s and state.command is not None:
        return None
    detail = f"the scan behind it ({state.pending.stamp_ns}) never arrived"
    return Cause("scan_behind_unknown", RAW, detail)


def scan_behind_old(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The scan behind the command is old, however fresh the command: a republisher, or a hang."""
    if state.command is None:
        return None
    detail = f"the scan behind {RAW} is old"
    age = now - state.behind_s
    return _judge_age("scan_behind_old", SCAN, detail, age, config.scan_age_s)


def e_stop_pressed(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The emergency stop was pressed."""
    if not state.e_stop.latched:
        return None
    if state.e_stop.held:
        return Cause("e_stop_pressed", E_STOP, "pressed")
    return Cause("e_stop_pressed", E_STOP, state.e_stop.reason or "was pressed")


def e_stop_silent(config: GateConfig, state: GateState, now: float) -> Cause | None:
    """The emergency stop is silent: a cut cable? An optional one must have been heard before."""
    age = math.inf
    if state.e_stop.heard_s is not None:
        age = now - state.e_stop.heard_s
    elif not config.e_stop_required:
        return None
    detail = "its heartbeat is silent, as if pressed"
    return _judge_age("e_stop_silent", E_STOP, detail, age, config.e_stop_silence_s)
