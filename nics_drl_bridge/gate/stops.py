"""Rules that stop the robot, and the gate's own clock and sources of commands that they judge."""

import math
from collections.abc import Callable
from typing import NamedTuple

from nics_drl_bridge.gate import estimate, frozen
from nics_drl_bridge.gate.arrivals import compute_age
from nics_drl_bridge.gate.inputs import E_STOP, ESTIMATE, RAW, Command, Input, Tick
from nics_drl_bridge.gate.state import Cause, GateConfig, GateState, replace
from nics_drl_bridge.middleware.measurement import ODOM, SCAN

SOURCE_S = 1.0  # time after which a command of another publisher is accepted [s]
# a running clock never gives this many consecutive inputs the same time
FROZEN_INPUTS = 20
NO_DATA = "no fresh data"


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


class Fault(NamedTuple):
    """What a rule finds.

    Attributes:
        detail: in words; empty if there is no fault.
        age_s: of data that may be too old.
        limit_s: beyond which an age is a fault.
        topic: of the cause, if it is not always that of the rule.
    """

    detail: str
    age_s: float = math.nan
    limit_s: float = math.nan
    topic: str = ""


class Rule(NamedTuple):
    """A reason to stop.

    Attributes:
        name: of the rule.
        topic: of the cause; empty for the gate itself.
        find: returns the fault at a time [s], if any.
        latches: the stop stays until a reset.
        needs_clock: it latches by elapsed time, so it is not judged while the gate's clock is at
            fault. Other rules may judge a wrong age: `own_clock` stops the robot anyway.
    """

    name: str
    topic: str
    find: Callable[[GateConfig, GateState, float], Fault]
    latches: bool = False
    needs_clock: bool = False

    def judge(self, config: GateConfig, state: GateState, now: float) -> Cause | None:
        """Returns the cause of a stop at a time [s], or None."""
        fault = self.find(config, state, now)
        # `<=` is false for an age of NaN, which is a fault, too.
        if not fault.detail or fault.age_s <= fault.limit_s:
            return None
        topic = fault.topic or self.topic
        return Cause(self.name, topic, fault.detail, fault.age_s, fault.limit_s)


NO_FAULT = Fault("")


def _find_press(config: GateConfig, state: GateState, now: float) -> Fault:
    stop = state.e_stop
    if not stop.latched:
        return NO_FAULT
    return Fault("pressed" if stop.held else stop.reason or "was pressed")


def _find_silent_e_stop(config: GateConfig, state: GateState, now: float) -> Fault:
    heard_s = state.e_stop.heard_s
    if heard_s is None and not config.e_stop_required:
        return NO_FAULT  # an optional one must have been heard before
    age_s = math.inf if heard_s is None else now - heard_s
    detail = "its heartbeat is silent, as if pressed"
    return Fault(detail, age_s, config.e_stop_silence_s)


def _find_silent_sensor(config: GateConfig, state: GateState, now: float) -> Fault:
    ages = [
        (compute_age(sensor.arrivals, now), name)
        for name, sensor in zip(config.sensors, state.sensors, strict=True)
    ]
    age_s, name = max(ages, default=(0.0, ""))
    return Fault(NO_DATA, age_s, config.scan_age_s, name)


def _find_lost_estimate(config: GateConfig, state: GateState, now: float) -> Fault:
    fault = state.estimates.fault
    if not fault or not config.estimate_required:
        return NO_FAULT
    return Fault(f"{fault}; {estimate.REMEDY}")


def _find_unknown_scan(config: GateConfig, state: GateState, now: float) -> Fault:
    if state.pending is None or state.pending_s is None:
        return NO_FAULT
    if now - state.pending_s <= config.race_s and state.command is not None:
        return NO_FAULT  # it may be in transit
    return Fault(f"the scan behind it ({state.pending.stamp_ns}) never arrived")


STOPS: tuple[Rule, ...] = (
    Rule("e_stop_pressed", E_STOP, _find_press, latches=True),
    Rule(
        "disarmed",
        "",
        lambda config, state, now: Fault(
            "" if state.armed else "call ~/arm to let commands pass"
        ),
    ),
    # The gate's clock can't be trusted, or the gate was asleep.
    Rule("own_clock", "", lambda config, state, now: Fault(state.clock_fault)),
    # A silent emergency stop may be a cut cable.
    Rule("e_stop_silent", E_STOP, _find_silent_e_stop, latches=True, needs_clock=True),
    # The stamps of a sensor lie in the future, or far back.
    Rule(
        "stamps_jumped",
        "",
        lambda config, state, now: Fault(
            state.jumped and "its stamps have jumped, or run ahead of time",
            topic=state.jumped,
        ),
        latches=True,
    ),
    # Odometry reports a pose that the robot can't have reached.
    Rule(
        "odom_jumped", ODOM, lambda config, state, now: Fault(state.leap), latches=True
    ),
    # The same scan repeats although odometry shows motion.
    Rule(
        "scan_frozen",
        SCAN,
        lambda config, state, now: Fault(state.frozen),
        latches=True,
    ),
    # The robot is commanded to move but odometry shows none: stuck, unpowered, or frozen data.
    Rule(
        "no_motion",
        ODOM,
        lambda config, state, now: Fault(frozen.find_stuck(config, state, now)),
        latches=True,
        needs_clock=True,
    ),
    # The scans show none of the motion of odometry: the body is held, its wheels spin.
    Rule(
        "body_held",
        SCAN,
        lambda config, state, now: Fault(state.scan_motion.held),
        latches=True,
    ),
    # The estimate jumped or quickly became uncertain: its localiser is lost.
    Rule("estimate_lost", ESTIMATE, _find_lost_estimate, latches=True),
    # Two publishers command the robot alternately.
    Rule(
        "two_policies", RAW, lambda config, state, now: Fault(state.mixed), latches=True
    ),
    # The lidar, an additional sensor, or odometry has stopped.
    Rule(
        "scan_silent",
        SCAN,
        lambda config, state, now: Fault(
            NO_DATA, compute_age(state.scans, now), config.scan_age_s
        ),
    ),
    Rule("sensor_silent", "", _find_silent_sensor),
    Rule(
        "odom_silent",
        ODOM,
        lambda config, state, now: Fault(
            NO_DATA, compute_age(state.odometries, now), config.odom_age_s
        ),
    ),
    Rule("command_malformed", RAW, lambda config, state, now: Fault(state.malformed)),
    Rule(
        "command_missing",
        RAW,
        lambda config, state, now: Fault(
            "no command yet" if state.command is state.pending is None else ""
        ),
    ),
    # The policy has stopped, or hangs.
    Rule(
        "command_silent",
        RAW,
        lambda config, state, now: Fault(
            "" if state.command is None else "no fresh command",
            now - state.command_s,
            config.command_age_s,
        ),
    ),
    # Commands name scans that do not arrive, perhaps from the future.
    Rule("scan_behind_unknown", RAW, _find_unknown_scan),
    # The scan behind the command is old, however fresh the command: a republisher, or a hang.
    Rule(
        "scan_behind_old",
        SCAN,
        lambda config, state, now: Fault(
            "" if state.command is None else f"the scan behind {RAW} is old",
            now - state.behind_s,
            config.scan_age_s,
        ),
    ),
)
"""The first rule that finds a fault names the stop; the first latching one latches it."""
