"""Faults injected around a gate, and how soon each must stop the robot.

As on a vehicle, the gate has its own process, and for some faults the policy, too. This process
publishes a robot's topics and corrupts them while the robot drives. The time counts from the last
good datum before the fault, or from the fault itself if it is an event, until a zero arrives on
`cmd_vel`.
"""

from __future__ import annotations

import itertools
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate.assurance.protocol import Protocol, Trial
from nics_drl_bridge.gate.assurance.run import Row
from nics_drl_bridge.gate.limits import Limits, load_limits
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes import conversions
from nics_drl_bridge.nodes.faulty_robot import (
    ALL,
    PATIENCE_S,
    PERIOD_S,
    NoMotionError,
    Robot,
)
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id
from nics_drl_bridge.robot.spec import RobotSpec

SOON_S = 0.10
LATE_S = 0.40
FROZEN_S = 0.5
WATCHED_S = 0.8  # after a fault's limit
LOG_CHARACTERS = 500
ROUNDING = 1e-9  # of a command that is read from a `cmd_vel`
GATE = "command_gate"
POLICY = "policy_node"
MAX_IDLE = 3  # attempts in a row to inject a fault into a robot that moves


Injection = Callable[["Surroundings"], object]
# Returns what is sent instead of a message, from it, the last one before the fault, and its number.
Change = Callable[[Any, Any, int], Any]


@dataclass(frozen=True)
class Fault:
    """A fault, and how it is injected."""

    limit_s: float  # within which a zero must follow
    inject: Injection | Sequence[Injection]  # one of several is drawn
    # topic from whose last good datum the limit counts; empty: from the fault itself
    since: str = ""
    policy: bool = False  # it needs a process of the policy
    # only the first command after the fault must be zero; after it, the robot may drive on
    first_word: bool = False


@dataclass(frozen=True)
class Injected:
    """Outcome of an injection."""

    time_s: float  # from the last good datum to zero; inf for never
    after_s: float  # from the fault to zero
    unsafe: int  # number of commands that should not have been sent


@dataclass(frozen=True)
class Setup:
    """A gate, or none, and the robot around it."""

    model: str
    limits: str
    # for logs; each process has a subfolder named after its first injection
    folder: Path
    # (3,) commanded to the robot, unless the policy does; None: at half its limits
    twist: Array | None = None
    policy: str = ""  # by default that of `policy_node`
    goal: tuple[float, float] = (1e6, 0.0)  # of the policy [m]
    gated: bool = True  # False: commands bypass the gate
    parameters: Mapping[str, Any] = field(default_factory=dict)  # of the gate
    patience_s: float = PATIENCE_S


def _silence(*topics: str) -> Injection:
    return lambda around: around.robot.silent.update(topics)


def _change(topic: str, change: Change) -> Injection:
    """Change each subsequent message of a topic."""

    def inject(around: Surroundings) -> None:
        held = around.robot.last.get(topic)
        numbers = itertools.count(1)
        around.robot.change[topic] = lambda message: change(
            message, held, next(numbers)
        )

    return inject


def _replace_command(x: float) -> Injection:
    def change(message: TwistStamped, *_: object) -> TwistStamped:
        message.twist = conversions.twist_to_ros([x, 0.0, 0.0])
        return message

    return _change("cmd_vel_raw", change)


def _shift_stamps(topic: str, off_s: float, growing: bool = False) -> Injection:
    """Shift a topic's stamps; by more with each message, if `growing`."""

    def change(message: Any, _: object, number: int) -> Any:
        off_ns = round(off_s * (number if growing else 1) * NS_PER_S)
        stamp_ns = conversions.stamp_from_ros(message.header.stamp) + off_ns
        message.header.stamp = conversions.stamp_to_ros(stamp_ns)
        return message

    return _change(topic, change)


def _freeze(topic: str, stamped: bool = False) -> Injection:
    """Repeat the last good message like a frozen driver, with current stamps if `stamped`."""

    def change(message: Any, held: Any, _: int) -> Any:
        if stamped:
            held.header.stamp = message.header.stamp
        return held

    return _change(topic, change)


def _alternate_scans(around: Surroundings) -> None:
    """Alternate between two scans, like a driver that swaps two buffers."""
    shown = [around.robot.last["scan"].ranges]

    def change(message: LaserScan, _: object, number: int) -> LaserScan:
        if number == 1:
            shown.append(message.ranges)
        message.ranges = shown[number % 2]
        return message

    _change("scan", change)(around)


def _freeze_but_one(message: LaserScan, held: LaserScan, number: int) -> LaserScan:
    """Repeat a scan in which one beam flickers."""
    message.ranges = [held.ranges[0] + 1e-3 * number, *held.ranges[1:]]
    return message


def _cut_beams(message: LaserScan, *_: object) -> LaserScan:
    message.ranges = message.ranges[:100]
    return message


def _clear_scan(message: LaserScan, *_: object) -> LaserScan:
    message.ranges = [float("nan")] * len(message.ranges)
    return message


def _move_odometry(x: float, y: float) -> Injection:
    """Shift the pose of odometry from now on."""

    def change(message: Odometry, *_: object) -> Odometry:
        message.pose.pose.position.x += x
        message.pose.pose.position.y += y
        return message

    return _change("odom", change)


def _jump(seconds: int) -> Injection:
    return lambda around: setattr(around.robot, "jump_ns", seconds * NS_PER_S)


def _signal(how: signal.Signals, republished: bool = False) -> Injection:
    """Send the policy a signal; its last command may be republished."""

    def inject(around: Surroundings) -> None:
        os.kill(around.processes[POLICY].pid, how)
        around.robot.republished = republished

    return inject


def _freeze_gate(around: Surroundings) -> None:
    """Freeze the gate itself for a while.

    Commands that it wrote before do not count, although the middleware, which freezes with it, may
    send the last one only afterwards.
    """
    if GATE not in around.processes:
        return
    pid = around.processes[GATE].pid
    os.kill(pid, signal.SIGSTOP)
    around.robot.until(lambda: False, FROZEN_S)
    around.robot.heard.clear()
    around.robot.since_ns = time.time_ns()
    os.kill(pid, signal.SIGCONT)


FAULTS: dict[str, Fault] = {
    "policy_killed": Fault(LATE_S, _signal(signal.SIGKILL), policy=True),
    "policy_frozen": Fault(LATE_S, _signal(signal.SIGSTOP), policy=True),
    "policy_hung": Fault(
        LATE_S, _signal(signal.SIGSTOP, republished=True), policy=True
    ),
    "scan_silent": Fault(LATE_S, _silence("scan"), "scan"),
    "odom_silent": Fault(LATE_S, _silence("odom"), "odom"),
    "nan_scan": Fault(LATE_S, _change("scan", _clear_scan), "scan"),
    "clock_jump": Fault(
        LATE_S,
        (_jump(10), _jump(-10), _jump(1), _jump(-1)),
        "scan",
    ),
    "e_stop": Fault(
        SOON_S,
        (
            lambda around: around.robot.press(),
            lambda around: around.robot.call("e_stop"),
        ),
    ),
    "e_stop_silent": Fault(LATE_S, _silence("e_stop"), "e_stop"),
    "all_silent": Fault(LATE_S, _silence(*ALL), "scan"),
    "command_silent": Fault(LATE_S, _silence("cmd_vel_raw"), "cmd_vel_raw"),
    "command_frozen": Fault(LATE_S, _freeze("cmd_vel_raw"), "cmd_vel_raw"),
    "command_nan": Fault(LATE_S, _replace_command(math.nan), "cmd_vel_raw"),
    "command_inf": Fault(LATE_S, _replace_command(math.inf), "cmd_vel_raw"),
    "command_absurd": Fault(LATE_S, _replace_command(1e9), "cmd_vel_raw"),
    "command_from_the_future": Fault(
        LATE_S, _shift_stamps("cmd_vel_raw", 3600.0), "cmd_vel_raw"
    ),
    "scan_of_another_lidar": Fault(LATE_S, _change("scan", _cut_beams), "scan"),
    "scan_stamps_frozen": Fault(LATE_S, _freeze("scan"), "scan"),
    "scan_from_the_future": Fault(LATE_S, _shift_stamps("scan", 3600.0), "scan"),
    "stamps_run_ahead": Fault(
        LATE_S,
        (
            _shift_stamps("scan", 0.35, growing=True),
            _shift_stamps("odom", 0.35, growing=True),
        ),
        "scan",
    ),
    "stamps_creep": Fault(1.20, _shift_stamps("scan", 0.02, growing=True), "scan"),
    "odom_teleports": Fault(
        LATE_S, (_move_odometry(3.0, 0.0), _move_odometry(0.0, -1.0)), "odom"
    ),
    "scan_frozen": Fault(1.50, _freeze("scan", stamped=True), "scan"),
    "scan_alternates": Fault(1.50, _alternate_scans, "scan"),
    "scan_frozen_but_one_beam": Fault(1.50, _change("scan", _freeze_but_one), "scan"),
    "no_motion": Fault(1.10, lambda around: setattr(around.robot, "stuck", True)),
    "gate_frozen": Fault(FROZEN_S + LATE_S, _freeze_gate, first_word=True),
}


# faults that only the gate reacts to, to show that an injection can fail
CONTROLS = ("scan_silent", "odom_silent", "nan_scan", "command_nan")


def judge_commands(
    fault: Fault, heard: Sequence[tuple[float, Array]], good_s: float, broken_s: float
) -> tuple[float, int]:
    """Return when the robot was finally commanded to stop [s], and how many commands came too late.

    `heard` holds times [s] and twists of commands since the fault.
    """
    moving_s = [when for when, twist in heard if twist.any()]
    zeros_s = [when for when, twist in heard if not twist.any()]
    late_s = [when for when in moving_s if when - good_s > fault.limit_s]
    if fault.first_word:
        first_s = min(zeros_s, default=math.inf)
        moving_s = late_s = [when for when in moving_s if when < first_s]
    last_s = max(moving_s, default=broken_s)
    stopped_s = min((when for when in zeros_s if when > last_s), default=math.inf)
    return stopped_s, len(late_s)


def is_within(robot: RobotSpec, limits: Limits, twist: Array) -> bool:
    """Return whether a `cmd_vel` (3,) keeps the limits of a robot's commands; NaN does not."""
    command = robot.from_cmd_vel(twist)
    inside = (command >= limits.low - ROUNDING) & (command <= limits.high + ROUNDING)
    # a car's steering angle follows from its turn rate only as far as it can steer
    return bool(inside.all()) and np.allclose(robot.to_cmd_vel(command), twist)


class Surroundings(ExitStack):
    """A robot and the processes around it, into which a fault is injected."""

    def __init__(self, setup: Setup, name: str, tell: Callable[[str], None]) -> None:
        super().__init__()
        self._setup = setup
        self._name = name
        self._tell = tell
        self._fault = FAULTS[name]
        self._domain_id = choose_domain_id()
        model = open_model(setup.model)
        limits = load_limits(setup.limits, model.robot)
        self._is_within = partial(is_within, model.robot, limits)
        twist = setup.twist
        if twist is None:
            command = 0.1 * np.where(limits.high > 0.0, limits.high, limits.low)
            command[0] *= 5.0
            twist = model.robot.to_cmd_vel(command)
        self.processes: dict[str, NodeProcess] = {}
        has_policy = self._fault.policy
        self.robot: Robot = Robot(
            self._domain_id, model, twist, has_policy, relayed=not setup.gated
        )
        self.callback(self.robot.close)

    def start_missing(self, folder: Path) -> None:
        """Start the processes that are needed and do not run, with their logs in a folder."""
        setup = self._setup
        needed: dict[str, dict[str, Any]] = {}
        if setup.gated:
            needed[GATE] = {
                "limits": setup.limits,
                "e_stop_required": True,
                "black_box": str(folder / "black_box"),
                "enable_stamped_cmd_vel": False,
                "stop_when_held": False,  # the robot's scans do not show how it moves
                **setup.parameters,
            }
        if self._fault.policy:
            needed[POLICY] = {"goal": [*setup.goal]}
            if setup.policy:
                needed[POLICY]["policy"] = setup.policy
        for node, parameters in needed.items():
            process = self.processes.get(node)
            if process is not None and _is_alive(process):
                continue
            if process is not None and node == GATE:
                self._tell(f"{self._name}: the gate has ended, and another is started")
            values = {"model": setup.model, **parameters}
            process = NodeProcess(node, folder, values, self._domain_id)
            self.processes[node] = self.enter_context(process)
            self.callback(_is_alive, process)  # one that is stopped would not end

    def inject(self, number: int) -> Injected:
        """Drive, inject a fault with a variant and a phase drawn from a number, and watch."""
        fault = self._fault
        robot = self.robot
        ways = [fault.inject] if callable(fault.inject) else fault.inject
        phase_s = np.random.default_rng(number).uniform(0.0, PERIOD_S)
        robot.drive(self._setup.patience_s, phase_s)
        robot.heard.clear()
        broken_s = time.monotonic()
        with suppress(TimeoutError):  # without an answer, what was heard decides
            ways[number % len(ways)](self)
        robot.until(lambda: False, fault.limit_s + WATCHED_S)
        good_s = broken_s
        if fault.since:
            good_s = min(robot.sent_s[fault.since], broken_s)
        stopped_s, unsafe = judge_commands(fault, robot.heard, good_s, broken_s)
        if self._setup.gated and self.processes[GATE].poll() is not None:
            stopped_s = math.inf  # a fault must not end the gate
        unsafe += sum(not self._is_within(twist) for _, twist in robot.heard)
        return Injected(stopped_s - good_s, stopped_s - broken_s, unsafe)

    def give_up(self, error: Exception) -> None:
        """Tell why nothing was injected; end a policy, since a killed one may leave DDS amiss."""
        line = f"{self._name}: {error}."
        policy = self.processes.pop(POLICY, None)
        if policy is not None:
            _is_alive(policy)
            policy.close()
            text = policy.log.read_text(encoding="utf-8", errors="replace")
            line = f"{line} Another policy is started: {text[-LOG_CHARACTERS:]}"
        self._tell(line)


def _is_alive(process: NodeProcess) -> bool:
    """Continue a process that was stopped; return False if it has ended."""
    try:
        os.kill(process.pid, signal.SIGCONT)
        process.check()
    except (BackendError, ProcessLookupError):
        return False
    return True


def inject_all(
    setup: Setup, name: str, numbers: Sequence[int], tell: Callable[[str], None]
) -> Iterator[Injected]:
    """Yield an injection of a fault for each number; fewer if the robot does not move.

    `tell` gets a line if an attempt fails. A policy or a gate that has ended is restarted.
    """
    with Surroundings(setup, name, tell) as around:
        for number in numbers:
            for attempt in range(MAX_IDLE):
                named = f"{number}_{attempt}" if attempt else f"{number}"
                try:
                    around.start_missing(setup.folder / named)
                    injected = around.inject(number)
                except (NoMotionError, TimeoutError) as error:  # nothing was injected
                    around.give_up(error)
                else:
                    yield injected
                    break
            else:
                return


def inject_trials(
    protocol: Protocol, folder: Path, tell: Callable[[str], None], trials: list[Trial]
) -> Iterator[Row]:
    """Yield a row for each trial whose fault was injected."""
    kinds = itertools.groupby(trials, lambda trial: (trial.kind, trial.gated))
    for (name, gated), group in kinds:
        logs = folder / (name if gated else f"{name}_no_gate")
        setup = Setup(
            protocol.model, protocol.limits, logs, policy=protocol.policy, gated=gated
        )
        alike = list(group)
        limit_s = FAULTS[name].limit_s
        injections = inject_all(setup, name, [trial.seed for trial in alike], tell)
        for trial, injected in zip(alike, injections, strict=False):
            in_time = injected.time_s <= limit_s and not injected.unsafe
            verdict = {"fault": True, "limit_s": limit_s, "in_time": in_time}
            yield trial._asdict() | verdict | asdict(injected)
