"""Robots that drive in the fast simulator beside a gate that only watches; and held bodies."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.inputs import Input, Odometry
from nics_drl_bridge.gate.state import Decision, GateConfig, begin
from nics_drl_bridge.gate.state import replace as change
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.geometry import between, compose, exp
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.robot.kinds import compute_steady_twist

RULE = "body_held"
EPISODE_STEPS = 600
WHEEL_LAG_S = 0.15  # with which the wheels of a held body follow commands
DRAWN_S = 0.5  # time for which a random command is kept
# Wheels that spin at less of both on average hardly move [m/s, rad/s].
ORDINARY = np.array([0.15, 0.3])
WATCHED_S = 1.0  # within which a held body is to be stopped
LONGEST_S = 3.0  # after which it is let go
FREE_S = (2.0, 6.0)  # for which it drives before, drawn
MOST_S_EACH = 60.0  # of driving, for each body that is to be held


@dataclass(frozen=True)
class Case:
    """What is driven."""

    robot: str
    world: str
    lidar: str = ""  # empty: the robot's own
    driver: str = (
        "dynamic_window"  # or `random`: commands that are drawn twice a second
    )
    rate: float = 10.0  # of scans [Hz]
    path_scale: float = 1.0  # what odometry shows for a path of one
    turn_scale: float = 1.0
    dropout: float = 0.0  # probability that a return is lost
    beams: int = 0  # 0: the lidar's own
    noise_told: float = 1.0  # share of the lidar's noise that the gate is told of


@dataclass
class Tally:
    """What came out."""

    driven_s: float = 0.0  # that robots drove, watched by a gate
    judged_s: float = 0.0  # of it, while the scans told something about the motion
    trips: list[str] = field(default_factory=list)  # stops by the rule of free robots
    other_stops: Counter[str] = field(
        default_factory=Counter
    )  # by other latching rules
    delays_s: list[float] = field(
        default_factory=list
    )  # of held bodies; inf: never stopped
    missed: list[str] = field(default_factory=list)  # what was too late

    def add(self, other: Tally) -> None:
        """Adds what came out of another case."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)


class Watcher(Gate):
    """A gate that watches one robot and whose commands nobody obeys."""

    def __init__(self, config: GateConfig, lidar: LidarSpec) -> None:
        super().__init__(config, lidar)
        self.restart()

    def restart(self) -> None:
        """Starts over, armed."""
        self.state = change(begin(self.config), armed=True)
        self.stopped = ""

    def give(self, event: Input) -> Decision:
        """Decides on an input, and notes the rule that stops the robot for good."""
        decision = super().give(event)
        if decision.cause is not None and self.state.latched is not None:
            self.stopped = self.stopped or decision.cause.rule
        return decision


def build_model(case: Case) -> tuple[SimulatorModel, int]:
    """Returns the model of a case, and in how many of its steps it scans once."""
    model = open_model(case.robot, case.lidar or None)
    steps = 2 if case.rate < 8.0 else 1
    dt = model.kinematics.dt
    period = round(1.0 / case.rate / steps / dt) * dt
    faults = model.lidar.faults.model_copy(update={"dropout": case.dropout})
    beams = case.beams or model.lidar.beams
    changes = {"beams": beams, "rate": 1.0 / (period * steps), "faults": faults}
    lidar = model.lidar.model_copy(update=changes)
    table = model.table
    if case.beams or case.dropout:
        table = bake(lidar, table.shapes)
    return replace(model, lidar=lidar, table=table, control_period=period), steps


class Drive:
    """Worlds with a robot each, its own odometry, and a gate that watches."""

    def __init__(self, case: Case, worlds: int, seed: int, has_rule: bool) -> None:
        self._case = case
        self._model, self._every = build_model(case)
        self.period = self._model.control_period
        self.rng = np.random.default_rng(seed)
        self._policy = None
        task: object = "navigation"
        if case.driver != "random":
            self._policy, task = open_policy(case.driver, self._model)
        self._env = BridgeVectorEnv(
            worlds, self._model, case.world, task, None, EPISODE_STEPS, "SameStep"
        )
        config = configure_gate(self._model, case.robot, shielded=False)
        told = tuple(case.noise_told * std for std in config.range_noise)
        config = change(
            config,
            odom_rate=1.0 / self.period,
            range_noise=told,
            stop_when_held=has_rule,
        )
        self.gates = [Watcher(config, self._model.lidar) for _ in range(worlds)]
        self._observation, _ = self._env.reset(seed=seed)
        self._data = self._env.simulator.data
        self._before = self._data.pose[:, 0].copy()
        self._odom = self._before.copy()
        self.wheel = np.zeros((worlds, 3))  # twists by the wheels
        self.held = np.zeros(worlds, bool)
        self._coefficients = self._data.coefficient.copy()
        self._noises = self._data.noise.copy()
        self._steps = 0
        self._drawn = self._env.action_space.sample()

    def hold(self, index: int, held: bool) -> None:
        """Holds a body, or lets it go."""
        self.held[index] = held
        factor = 0.0 if held else 1.0
        self._data.coefficient[index] = factor * self._coefficients[index]
        self._data.noise[index, :, 2:] = factor * self._noises[index, :, 2:]

    def _choose_actions(self) -> NDArray[np.float32]:
        if self._policy is not None:
            return self._policy.act(self._observation)
        if self._steps % max(1, round(DRAWN_S / self.period)) == 0:
            self._drawn[:] = self.rng.uniform(-1.0, 1.0, self._drawn.shape)
        return self._drawn

    def step(self) -> NDArray[np.bool_]:
        """Steps all worlds and their gates; returns which worlds began another episode."""
        action = self._choose_actions()
        commands = np.asarray(self._env.task.command(action))
        commands = commands.reshape(len(self.gates), -1)
        self._observation, _, ended, cut, _ = self._env.step(action)
        self._steps += 1
        began = ended | cut
        pose = self._data.pose[:, 0]
        shown = self._show_motion(between(self._before, pose), commands)
        self._odom = np.where(began[:, None], pose, compose(self._odom, shown))
        self._before = pose.copy()
        self._watch(commands, shown / self.period, began)
        return began

    def _show_motion(self, moved: Array, commands: Array) -> Array:
        """Returns the motion (N, 3) by odometry: of spinning wheels where a body is held."""
        told = compute_steady_twist(self._model.robot, commands)
        follows = min(1.0, self.period / WHEEL_LAG_S)
        spun = self.wheel + follows * (told - self.wheel)
        held = self.held[:, None]
        self.wheel = np.where(held, spun, moved / self.period)
        moved = np.where(held, exp(spun * self.period), moved)
        path = self._case.path_scale
        along, about = self._model.noise.odometry[:2]
        std = np.array([along, along, about]) * self.period
        noise = self.rng.normal(size=moved.shape) * std
        return moved * [path, path, self._case.turn_scale] + noise

    def _watch(self, commands: Array, twists: Array, began: NDArray[np.bool_]) -> None:
        ranges = self._data.ranges[:, 0]
        for i, gate in enumerate(self.gates):
            if began[i] and not self.held[i]:
                gate.restart()
            gate.now += self.period
            if self._steps % self._every == 0:
                gate.sense(ranges[i], self._odom[i], twists[i])
            else:
                stamp_ns = round(gate.now * NS_PER_S)
                gate.give(Odometry(stamp_ns, self._odom[i].copy(), twists[i]))
            gate.command(self._model.robot.to_cmd_vel(commands[i]))
            gate.tick()


def drive_freely(
    case: Case, worlds: int, seconds: float, seed: int, has_rule: bool = True
) -> Tally:
    """Drives robots freely, and counts by what their gates were stopped."""
    drive = Drive(case, worlds, seed, has_rule)
    tally = Tally()
    for _ in range(round(seconds / drive.period)):
        drive.step()
        for gate in drive.gates:
            tally.driven_s += drive.period
            if not math.isnan(gate.state.scan_motion.share):
                tally.judged_s += drive.period
            if gate.stopped == RULE:
                tally.trips.append(f"{case}: {gate.state.latched.detail}")
            elif gate.stopped:
                tally.other_stops[gate.stopped] += 1
            if gate.stopped:
                gate.restart()
    return tally


class Hold:
    """The body of one world: driven for a while, then held until it is stopped."""

    def __init__(self, drive: Drive, index: int) -> None:
        self._drive = drive
        self._index = index
        self.release()

    def release(self) -> None:
        """Lets the body drive."""
        self._drive.hold(self._index, False)
        self._drive.gates[self._index].restart()
        self._wait_s = self._drive.rng.uniform(*FREE_S)
        self._since_s = 0.0
        self._spun = np.zeros(2)

    @property
    def _wheels(self) -> Array:
        """Speed [m/s] and turn rate [rad/s] of the wheels, as magnitudes."""
        x, y, turn = self._drive.wheel[self._index].tolist()
        return np.array([math.hypot(x, y), abs(turn)])

    def step(self, began: bool, tally: Tally) -> None:
        """Accounts for a step, in which another episode may have begun."""
        drive = self._drive
        gate = drive.gates[self._index]
        self._since_s += drive.period
        if began:
            self.release()
        elif not drive.held[self._index]:
            if gate.stopped:
                tally.trips += ["before it was held"] * (gate.stopped == RULE)
                gate.restart()
            if self._since_s >= self._wait_s and (self._wheels >= ORDINARY).any():
                drive.hold(self._index, True)
                self._since_s = 0.0
                self._spun = np.zeros(2)
        else:
            if self._since_s <= WATCHED_S:
                self._spun += self._wheels * drive.period
            if gate.stopped or self._since_s >= LONGEST_S:
                self._count(gate.stopped, tally)
                self.release()

    def _count(self, stopped: str, tally: Tally) -> None:
        mean = self._spun / min(WATCHED_S, self._since_s)
        if not (mean >= ORDINARY).any():
            return
        if stopped not in (RULE, ""):  # as of a lidar without noise, whose scans freeze
            tally.other_stops[stopped] += 1
        delay = self._since_s if stopped else math.inf
        tally.delays_s.append(delay)
        if delay > WATCHED_S + 1e-6:
            spun = mean.round(2).tolist()
            tally.missed.append(
                f"{self._drive._case} at {spun} m/s, rad/s: {delay:.2f} s"
            )


def hold_bodies(
    case: Case, worlds: int, holds: int, seed: int, has_rule: bool = True
) -> Tally:
    """Holds bodies while they drive, and counts how long each was not stopped."""
    drive = Drive(case, worlds, seed, has_rule)
    tally = Tally()
    bodies = [Hold(drive, index) for index in range(worlds)]
    for _ in range(round(MOST_S_EACH * holds / worlds / drive.period)):
        began = drive.step()
        for body, new in zip(bodies, began.tolist(), strict=True):
            body.step(new, tally)
        if len(tally.delays_s) >= holds:
            break
    return tally
