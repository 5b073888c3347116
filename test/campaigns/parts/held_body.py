"""Robots that drive in the fast simulator beside a gate that only watches; and held bodies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.gate import scan_motion
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Command, Odometry, Scan, Tick
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import GateConfig, GateState, Push, begin
from nics_drl_bridge.gate.stopping import make_gate_config
from nics_drl_bridge.generator import open_model
from nics_drl_bridge.geometry import between, compose, exp
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.robot.kinds import compute_steady_twist

Array = NDArray[np.float64]
RULE = "body_held"
ALWAYS = Push(0.0, 0.0, 0.0, np.zeros(3))
EPISODE_STEPS = 600
WHEEL_LAG_S = 0.15  # with which the wheels of a held body follow commands
DRAWN_S = 0.5  # time for which a random command is kept
ORDINARY = np.array([0.15, 0.3])
"""Wheels that spin at less of both, on average over the first second, hardly move [m/s, rad/s]."""
WATCHED_S, LONGEST_S = 1.0, 3.0
"""Time within which a held body is to be stopped, and after which it is let go."""
FREE_S = (2.0, 6.0)
"""Time for which it drives before, drawn."""
MOST_S_EACH = 60.0
"""Time of driving after which no more bodies are held, for each that is to be [s]."""


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
        missed: what was too late.
    """

    driven_s: float = 0.0
    judged_s: float = 0.0
    trips: list[str] = field(default_factory=list)
    other_stops: Counter[str] = field(default_factory=Counter)
    delays_s: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Adds what came out of another case."""
        self.driven_s += other.driven_s
        self.judged_s += other.judged_s
        self.trips += other.trips
        self.other_stops += other.other_stops
        self.delays_s += other.delays_s
        self.missed += other.missed


class Watched:
    """A gate that watches one robot and whose commands nobody obeys."""

    def __init__(self, config: GateConfig) -> None:
        self.config = config
        self.now = 100.0
        self.arm()

    def arm(self) -> None:
        """Starts over, armed."""
        self.state: GateState = replace(begin(self.config), armed=True)
        self.stopped = ""

    @property
    def tells_motion(self) -> bool:
        """Whether the newest scan told how far the robot moved."""
        return not math.isnan(self.state.scan_motion.share)

    def give(self, event: object) -> Array:
        """Decides on an input; returns the twist that would be published."""
        self.state, decision = decide(self.config, self.state, event, self.now)
        cause = decision.cause
        if cause is not None and not self.stopped and self.state.latched is not None:
            self.stopped = cause.rule
        return decision.twist


class RuleAlone(Watched):
    """The same with the rule alone, ten times as fast; the robot is always told to move."""

    def give(self, event: object) -> Array:
        """Takes odometry and scans."""
        if isinstance(event, Odometry):
            self.state = replace(self.state, odometry=event, push=ALWAYS)
        elif isinstance(event, Scan):
            motion = scan_motion.watch_scan(self.config, self.state, event)
            self.state = replace(self.state, scan_motion=motion)
            if (
                cause := scan_motion.body_held(self.config, self.state, self.now)
            ) is not None:
                self.state = replace(self.state, latched=cause)
                self.stopped = RULE
        return np.zeros(3)


class Drive:
    """Worlds with a robot each, its own odometry, and a gate that watches."""

    def __init__(
        self,
        case: Case,
        worlds: int,
        seed: int,
        change: Callable[[GateConfig], GateConfig],
        kind: type[Watched] = Watched,
    ) -> None:
        self.case = case
        model = open_model(case.robot, case.lidar or None)
        lidar = model.lidar
        period = 0.1
        every = round(10.0 / case.rate)
        if (
            every < 2 or abs(10.0 / case.rate - every) > 0.05
        ):  # a whole number of the model's steps
            every = 2 if case.rate < 8.0 else 1
            period = (
                round(1.0 / case.rate / every / model.kinematics.dt)
                * model.kinematics.dt
            )
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
        self.model = model
        self.period = period
        self.every = every
        self.rng = np.random.default_rng(seed)
        self.policy = None
        task: object = "navigation"
        if case.driver != "random":
            self.policy, task = open_policy(case.driver, model)
        self.env = BridgeVectorEnv(
            worlds, model, case.world, task, None, EPISODE_STEPS, "SameStep"
        )
        config = make_gate_config(
            model,
            load_limits(case.robot, model.robot),
            None,
            e_stop_required=False,
            estimate_required=False,
            odom_rate=1.0 / period,
        )
        told = tuple(case.noise_told * std for std in config.range_noise)
        self.config = change(replace(config, range_noise=told))
        self.gates = [kind(self.config) for _ in range(worlds)]
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
        if self.policy is not None:
            return self.policy.act(self.observation)
        if self.steps % max(1, round(DRAWN_S / self.period)) == 0 or self.drawn is None:
            self.drawn = np.asarray(self.env.action_space.sample())
            self.drawn[:] = self.rng.uniform(-1.0, 1.0, self.drawn.shape)
        return self.drawn

    def step(self) -> NDArray[np.bool_]:
        """Steps all worlds and their gates; returns which worlds began another episode."""
        action = self._actions()
        robot = self.model.robot
        data = self.env.simulator.data
        commands = np.asarray(self.env.task.command(action)).reshape(
            len(self.gates), -1
        )
        self.observation, _, ended, cut, _ = self.env.step(action)
        self.steps += 1
        began = ended | cut
        pose = data.pose[:, 0]
        moved = between(self.before, pose)
        scale = np.array(
            [self.case.path_scale, self.case.path_scale, self.case.turn_scale]
        )
        for i in range(len(self.gates)):
            if self.held[i]:
                told = compute_steady_twist(robot, commands[i : i + 1])[0]
                self.wheel[i] += (told - self.wheel[i]) * min(
                    1.0, self.period / WHEEL_LAG_S
                )
                moved[i] = exp(self.wheel[i] * self.period)
            else:
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
        robot = self.model.robot
        lidar = self.model.lidar
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
    case: Case,
    worlds: int,
    seconds: float,
    seed: int,
    change: Callable[[GateConfig], GateConfig] = lambda config: config,
) -> Tally:
    """Drives robots freely, and counts by what their gates were stopped."""
    drive = Drive(case, worlds, seed, change, RuleAlone)
    tally = Tally()
    for _ in range(round(seconds / drive.period)):
        drive.step()
        for gate in drive.gates:
            tally.driven_s += drive.period
            if gate.tells_motion:
                tally.judged_s += drive.period
            if gate.stopped == RULE:
                tally.trips.append(f"{case}: {gate.state.latched.detail}")
            elif gate.stopped:
                tally.other_stops[gate.stopped] += 1
            if gate.stopped:
                gate.arm()
    return tally


class Hold:
    """The body of one world: driven for a while, then held until it is stopped.

    Args:
        drive: the worlds.
        index: of the world.
    """

    def __init__(self, drive: Drive, index: int) -> None:
        self._drive = drive
        self._index = index
        self.release()

    def release(self) -> None:
        """Lets the body drive."""
        self._drive.hold(self._index, False)
        self._drive.gates[self._index].arm()
        self._wait_s = self._drive.rng.uniform(*FREE_S)
        self._since_s = 0.0
        self._spun = np.zeros(2)

    @property
    def _wheels(self) -> Array:
        """Speed [m/s] and turn rate [rad/s] that odometry shows, as magnitudes."""
        x, y, turn = self._drive.wheel[self._index].tolist()
        return np.array([math.hypot(x, y), abs(turn)])

    @property
    def _ordinary(self) -> bool:
        passed = min(WATCHED_S, self._since_s)
        return bool((self._spun / passed >= ORDINARY).any())

    def step(self, began: bool, tally: Tally) -> None:
        """Accounts for a step, in which another episode may have begun."""
        drive = self._drive
        gate = self._drive.gates[self._index]
        held = drive.held[self._index]
        self._since_s += drive.period
        if began:
            self.release()
        elif not held:
            if gate.stopped:
                tally.trips += ["before it was held"] if gate.stopped == RULE else []
                gate.arm()
            if self._since_s >= self._wait_s and (self._wheels >= ORDINARY).any():
                drive.hold(self._index, True)
                self._since_s, self._spun = 0.0, np.zeros(2)
        else:
            if self._since_s <= WATCHED_S:
                self._spun += self._wheels * drive.period
            if gate.stopped or self._since_s >= LONGEST_S:
                self._count(gate.stopped, tally)
                self.release()

    def _count(self, stopped: str, tally: Tally) -> None:
        if not self._ordinary:
            return
        if stopped not in (
            RULE,
            "",
        ):  # as of a lidar without noise, whose scans are frozen
            tally.other_stops[stopped] += 1
        delay = self._since_s if stopped else math.inf
        tally.delays_s.append(delay)
        if delay > WATCHED_S + 1e-6:
            spun = (self._spun / WATCHED_S).round(2).tolist()
            tally.missed.append(
                f"{self._drive.case} at {spun} m/s, rad/s: {delay:.2f} s"
            )


def hold_bodies(
    case: Case,
    worlds: int,
    holds: int,
    seed: int,
    change: Callable[[GateConfig], GateConfig] = lambda config: config,
) -> Tally:
    """Holds bodies while they drive, and counts how long each was not stopped."""
    drive = Drive(case, worlds, seed, change)
    tally = Tally()
    bodies = [Hold(drive, index) for index in range(worlds)]
    for _ in range(round(MOST_S_EACH * holds / worlds / drive.period)):
        began = drive.step()
        for body, new in zip(bodies, began.tolist(), strict=True):
            body.step(new, tally)
        if len(tally.delays_s) >= holds:
            break
    return tally
