"""Robots that drive in the fast simulator beside a gate that only watches; and held bodies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Command, Odometry, Scan, Tick
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.scan_motion import SETTINGS, judge_motion
from nics_drl_bridge.gate.state import GateConfig, GateState, begin
from nics_drl_bridge.gate.stopping import gate_config
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.geometry import between, compose, exp
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.robot.kinds import steady_twist

Array = NDArray[np.float64]
RULE = "body_held"
EPISODE_STEPS = 600
ORDINARY_SPEED, ORDINARY_TURN = 0.15, 0.3
"""Wheels that spin at less, on average over the first second, hardly move [m/s, rad/s]."""


@dataclass(frozen=True)
class Case:
    """What is driven.

    Attributes:
        robot: shipped.
        world: shipped.
        lidar: shipped; empty for the robot's own.
        driver: a policy or planner; `random` for commands that are drawn twice a second.
        rate: scans per second [Hz]; odometry comes as often.
        path_scale: what odometry shows for a path of one.
        turn_scale: the same for a turn.
        dropout: probability that a return is lost.
        beams: number of beams; 0 for the lidar's own.
        noise_told: share of the lidar's noise that the gate is told of.
    """

    robot: str
    world: str
    lidar: str = ""
    driver: str = "dynamic_window"
    rate: float = 10.0
    path_scale: float = 1.0
    turn_scale: float = 1.0
    dropout: float = 0.0
    beams: int = 0
    noise_told: float = 1.0


@dataclass
class Tally:
    """What came out.

    Attributes:
        driven_s: time that robots drove, watched by a gate [s].
        judged_s: part of it in which the scans told something about the motion [s].
        trips: stops by the rule while the robot drove freely.
        other_stops: stops by other latching rules.
        delays_s: of each held body, the time until it was stopped; inf for never.
        lowest: least share of the motion that scans showed of a free robot.
    """

    driven_s: float = 0.0
    judged_s: float = 0.0
    trips: list[str] = field(default_factory=list)
    other_stops: Counter[str] = field(default_factory=Counter)
    delays_s: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    lowest: list[float] = field(default_factory=list)
    near: int = 0

    def add(self, other: Tally) -> None:
        """Adds what came out of another case."""
        self.driven_s += other.driven_s
        self.judged_s += other.judged_s
        self.trips += other.trips
        self.other_stops += other.other_stops
        self.delays_s += other.delays_s
        self.missed += other.missed
        self.lowest += other.lowest


class Watched:
    """A gate that watches one robot and whose commands nobody obeys."""

    def __init__(self, config: GateConfig) -> None:
        self.config = config
        self.now = 100.0
        self.arm()

    def arm(self) -> None:
        """Begins anew, armed."""
        self.state: GateState = replace(begin(self.config), armed=True)
        self.stopped = ""

    def give(self, event: object) -> Array:
        """Decides on an input; returns the twist that would be published."""
        self.state, decision = decide(self.config, self.state, event, self.now)
        cause = decision.cause
        if cause is not None and not self.stopped and self.state.latched is not None:
            self.stopped = cause.rule
        return decision.twist


class Drive:
    """Worlds with a robot each, its own odometry, and a gate that watches."""

    def __init__(
        self, case: Case, worlds: int, seed: int, change: Callable[[GateConfig], GateConfig]
    ) -> None:
        self.case = case
        model = open_model(case.robot, case.lidar or None)
        lidar = model.lidar
        period, every = 0.1, round(10.0 / case.rate)
        if every < 2 or abs(10.0 / case.rate - every) > 0.05:  # a whole number of the model's steps
            every = 2 if case.rate < 8.0 else 1
            period = round(1.0 / case.rate / every / model.kinematics.dt) * model.kinematics.dt
        faults = lidar.faults.model_copy(update={"dropout": case.dropout})
        lidar = lidar.model_copy(
            update={
                "beams": case.beams or lidar.beams,
                "rate": 1.0 / (period * every),
                "faults": faults,
            }
        )
        model = replace(model, lidar=lidar, control_period=period)
        if case.beams or case.dropout:
            from nics_drl_bridge.lidar.bake import bake

            model = replace(model, table=bake(lidar, model.table.shapes))
        self.model, self.period = model, period
        self.every = every
        self.rng = np.random.default_rng(seed)
        self.policy = None
        task: object = "navigation"
        if case.driver != "random":
            self.policy, task = open_policy(case.driver, model)
        self.env = BridgeVectorEnv(worlds, model, case.world, task, None, EPISODE_STEPS, "SameStep")
        noise = tuple(
            case.noise_told * std for std in (lidar.noise_std, lidar.faults.noise_proportional)
        )
        config = gate_config(
            model, load_limits(case.robot, model.robot), None, e_stop_required=False,
            estimate_required=False, odom_rate=1.0 / period,
        )  # fmt: skip
        self.config = change(replace(config, range_noise=noise))
        self.gates = [Watched(self.config) for _ in range(worlds)]
        self.observation, _ = self.env.reset(seed=seed)
        data = self.env.simulator.data
        self.before = data.pose[:, 0].copy()
        self.odom = data.pose[:, 0].copy()
        self.wheel = np.zeros((worlds, 3))
        self.held = np.zeros(worlds, bool)
        self.coefficients = data.coefficient.copy()
        self.noises = data.noise.copy()
        self.steps = 0
        self.drawn = None

    def hold(self, index: int, held: bool) -> None:
        """Holds a body, or lets it go."""
        data = self.env.simulator.data
        self.held[index] = held
        data.coefficient[index] = 0.0 if held else self.coefficients[index]
        data.noise[index, :, 2:] = 0.0 if held else self.noises[index, :, 2:]

    def _actions(self) -> NDArray[np.float32]:
        count = len(self.gates)
        if self.policy is not None:
            return self.policy.act(self.observation)
        if self.steps % max(1, round(0.5 / self.period)) == 0 or self.drawn is None:
            self.drawn = np.asarray(self.env.action_space.sample())
            self.drawn[:] = self.rng.uniform(-1.0, 1.0, self.drawn.shape)
        del count
        return self.drawn

    def step(self) -> NDArray[np.bool_]:
        """Steps all worlds and their gates; returns which worlds began another episode."""
        action = self._actions()
        robot, data = self.model.robot, self.env.simulator.data
        commands = np.asarray(self.env.task.command(action)).reshape(len(self.gates), -1)
        self.observation, _, ended, cut, _ = self.env.step(action)
        self.steps += 1
        began = ended | cut
        pose = data.pose[:, 0]
        moved = between(self.before, pose)
        scale = np.array([self.case.path_scale, self.case.path_scale, self.case.turn_scale])
        for i in range(len(self.gates)):
            if self.held[i]:
                told = steady_twist(robot, commands[i : i + 1])[0]
                self.wheel[i] += (told - self.wheel[i]) * min(1.0, self.period / 0.15)
                moved[i] = exp(self.wheel[i] * self.period)
            else:
                moved[i] = np.array([1.0, 1.0, 1.0]) * moved[i]
                self.wheel[i] = moved[i] / self.period
        noise = self.model.noise.odometry
        shown = moved * scale
        std = np.array([noise[0], noise[0], noise[1]]) * self.period
        shown = shown + self.rng.normal(size=shown.shape) * std
        self.odom = np.where(began[:, None], pose, compose(self.odom, shown))
        self.before = pose.copy()
        self._watch(commands, shown / self.period, began)
        return began

    def _watch(self, commands: Array, twists: Array, began: NDArray[np.bool_]) -> None:
        robot, lidar = self.model.robot, self.model.lidar
        ranges = self.env.simulator.data.ranges[:, 0]
        angles = (lidar.angle_min, lidar.angle_increment)
        for i, gate in enumerate(self.gates):
            if began[i] and not self.held[i]:
                gate.arm()
            gate.now += self.period
            stamp = round(gate.now * NS_PER_S)
            gate.give(Odometry(stamp, self.odom[i].copy(), twists[i].copy()))
            if self.steps % self.every == 0:
                gate.give(Scan(stamp, ranges[i].copy(), angles))
            command = Command(
                gate.state.scans.stamps_ns[-1] if gate.state.scans.times else 0,
                robot.to_cmd_vel(commands[i]),
            )
            gate.give(command)
            gate.give(Tick())


def drive_freely(
    case: Case, worlds: int, seconds: float, seed: int,
    change: Callable[[GateConfig], GateConfig] = lambda config: config,
    watch: bool = False,
) -> Tally:  # fmt: skip
    """Drives robots freely, and counts by what their gates were stopped."""
    drive, tally = Drive(case, worlds, seed, change), Tally()
    for _ in range(round(seconds / drive.period)):
        drive.step()
        for gate in drive.gates:
            tally.driven_s += drive.period
            motion = gate.state.scan_motion
            if gate.stopped == RULE:
                tally.trips.append(f"{case}: {gate.state.latched.detail}")
            elif gate.stopped:
                tally.other_stops[gate.stopped] += 1
            if gate.stopped:
                gate.arm()
            if watch and len(motion.views) > 2:
                verdict = judge_motion(gate.config, motion.views[:-1], motion.views[-1], SETTINGS)
                if not math.isnan(verdict.share):
                    tally.judged_s += drive.period
                    tally.lowest.append(verdict.share)
                    tally.near += verdict.held
    return tally


def hold_bodies(
    case: Case, worlds: int, holds: int, seed: int,
    change: Callable[[GateConfig], GateConfig] = lambda config: config,
) -> Tally:  # fmt: skip
    """Holds bodies while they drive, and counts how long each was not stopped."""
    drive, tally = Drive(case, worlds, seed, change), Tally()
    period = drive.period
    free_s, held_s = 2.0, 3.0
    began = np.zeros(worlds, int)
    wait = drive.rng.integers(round(free_s / period), round(3 * free_s / period), worlds)
    spun = np.zeros((worlds, 2))
    steps = 0
    while len(tally.delays_s) < holds and steps < 200 * holds:
        steps += 1
        new = drive.step()
        for i, gate in enumerate(drive.gates):
            began[i] += 1
            if not drive.held[i]:
                if gate.stopped:
                    tally.trips += [gate.stopped] if gate.stopped == RULE else []
                    gate.arm()
                if new[i]:
                    began[i] = 0
                fast = (
                    abs(drive.wheel[i, :2]).max() > ORDINARY_SPEED
                    or abs(drive.wheel[i, 2]) > ORDINARY_TURN
                )
                if began[i] >= wait[i] and fast:
                    drive.hold(i, True)
                    began[i], spun[i] = 0, 0.0
                continue
            if new[i]:
                drive.hold(i, False)
                began[i] = 0
                gate.arm()
                continue
            if began[i] * period <= 1.0:
                spun[i] += np.hypot(*drive.wheel[i, :2]) * period, abs(drive.wheel[i, 2]) * period
            over = began[i] * period >= held_s
            if gate.stopped or over:
                ordinary = spun[i] / min(1.0, began[i] * period)
                if ordinary[0] >= ORDINARY_SPEED or ordinary[1] >= ORDINARY_TURN:
                    delay = began[i] * period if gate.stopped == RULE else math.inf
                    if gate.stopped in (RULE, ""):
                        tally.delays_s.append(delay)
                        if not delay <= 1.0:
                            held_since_ns = gate.state.scan_motion.held_since_ns
                            tally.missed.append(f"{delay:.2f} {ordinary.round(2)} {held_since_ns}")
                    else:
                        tally.other_stops[gate.stopped] += 1
                drive.hold(i, False)
                began[i] = 0
                gate.arm()
    return tally
