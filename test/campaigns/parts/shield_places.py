"""A robot in a world of its own, for the shield's benchmark: what happens to it, and what it costs.

The world moves in short steps; its base looks for a command once per control period, as a slow one
does, and stops when commands fall silent.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from parts.adversaries import (
    ADVERSARIES,
    Adversary,
    Driver,
    GoalDriver,
    Standing,
    Truth,
)

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

Array = NDArray[np.float64]
STEP_S = 0.02
SCAN_STEPS = 5
BASE_STEPS = 5
ADVERSARY_S = 5.0
GOAL_S = 25.0
MOVING, MOVING_STEPS = 0.02, 10
"""A robot whose true place moved more slowly than that, over so many steps before a touch, stood
and was walked into [m/s]. At rest the car's own noise shakes it by up to 0.012 m/s."""
SILENCE_S = 0.5
GOAL = "goal"


@dataclass(frozen=True)
class Job:
    """One episode that is to be driven.

    Attributes:
        kind: of the driver: an adversary, or `goal`.
        seed: of scene and driver.
        standing: whether the driver only stands.
    """

    kind: str
    seed: int
    standing: bool = False

    @property
    def longest_s(self) -> float:
        """How long it may take [s]."""
        return GOAL_S if self.kind == GOAL else ADVERSARY_S


@dataclass
class Outcome:
    """How an episode went.

    Attributes:
        kind: of its driver.
        contact: the robot moved when it touched something.
        walked_into: it stood when something touched it.
        latched: the rule by which the gate latched a stop; empty for none.
        reached: it came to its goal.
        path: that it drove [m].
        seconds: that it took [s].
        speed: at the touch, if any [m/s].
        silence: the longest time for which its gate said nothing, over DDS [s].
        where: robot, world and seed.
    """

    kind: str
    contact: bool = False
    walked_into: bool = False
    latched: str = ""
    reached: bool = False
    path: float = 0.0
    seconds: float = 0.0
    speed: float = 0.0
    silence: float = 0.0
    where: tuple[str, str, int] = field(default=("", "", 0))


class Place:
    """One shipped robot in one shipped world.

    Args:
        robot: its name.
        world: its name.

    Attributes:
        model: of the robot, with its own control period.
        outcome: of the running episode.
        odom: (3,) pose by odometry; it runs on from one episode to the next.
    """

    def __init__(self, robot: str, world: str) -> None:
        self.robot = robot
        self.world = world
        model = builtin_model(robot)
        lidar = model.lidar.model_copy(update={"rate": 1.0 / (SCAN_STEPS * STEP_S)})
        self.model = replace(model, lidar=lidar)
        self._sim = FastSimulator(
            replace(self.model, control_period=STEP_S),
            load_world(world),
            renderer="auto",  # right also beside an obstacle
        )
        self._walls = self._sim.world.all_walls()
        self._drivers: dict[str, Driver] = {}
        self.odom = np.zeros(3)
        self.begin(Job(ADVERSARIES[0], 0))

    def begin(self, job: Job) -> None:
        """Places the robot in the scene of a job; it stands."""
        self.job = job
        self._steps = 0
        self._sim.reset([job.seed])
        self._begun, self._anchor = self._sim.data.odom[0, 0].copy(), self.odom.copy()
        self._lately = deque(
            [self._sim.data.pose[0, 0, :2].copy()], maxlen=MOVING_STEPS + 1
        )
        self.outcome = Outcome(job.kind, where=(self.robot, self.world, job.seed))
        rng = np.random.default_rng([7, job.seed])
        self._phase = int(rng.integers(BASE_STEPS))
        self._command = np.zeros((1, 1, len(self.model.robot.command)))
        self._driver: Driver
        if job.standing:
            self._driver = Standing(self.model)
        elif job.kind == GOAL:
            self._driver = self._drivers.setdefault(GOAL, GoalDriver(self.model))
        else:
            self._driver = Adversary(job.kind, self.model, rng)

    @property
    def truth(self) -> Truth:
        """All that there is to know now."""
        data = self._sim.data
        obstacles = self._sim.obstacles[0]
        return Truth(
            data.pose[0, 0].copy(),
            data.twist[0, 0].copy(),
            data.ranges[0, 0].copy(),
            obstacles[:, [X, Y, RADIUS]],
            data.velocity[0, :, :2].copy(),
            self._walls,
            self._sim.goals[0, 0],
        )

    def wish(self, truth: Truth) -> Array:
        """What the driver wants (3,) for `cmd_vel_raw`."""
        return self.model.robot.to_cmd_vel(self._driver.act(truth))

    def step(self, told: Array) -> None:
        """Moves on by `STEP_S`; `told` (3,) is what `cmd_vel` says now."""
        data = self._sim.data
        outcome = self.outcome
        if (self._steps + self._phase) % BASE_STEPS == 0:
            self._command[0, 0] = self.model.robot.from_cmd_vel(told)
        touched = bool(data.collided[0, 0])
        self._sim.step(self._command)
        self._steps += 1
        before = self._speed()
        outcome.path += float(np.hypot(*(data.pose[0, 0, :2] - self._lately[-1])))
        self._lately.append(data.pose[0, 0, :2].copy())
        outcome.seconds = self._steps * STEP_S
        if data.collided[0, 0] and not touched:
            outcome.speed = max(
                before, self._speed()
            )  # the touch itself may have stopped it
            outcome.contact = outcome.speed > MOVING
            outcome.walked_into = not outcome.contact
        self.odom = geometry.compose(
            self._anchor, geometry.between(self._begun, data.odom[0, 0])
        )

    def _speed(self) -> float:
        """Over the last steps, by true places; what odometry says of it is noisy [m/s]."""
        steps = len(self._lately) - 1
        way = float(np.hypot(*(self._lately[-1] - self._lately[0])))
        return way / (steps * STEP_S) if steps else 0.0

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        outcome = self.outcome
        if self.job.kind == GOAL and not self.job.standing and not outcome.reached:
            near = np.hypot(*(self._sim.data.pose[0, 0, :2] - self._sim.goals[0, 0]))
            outcome.reached = bool(near < GoalDriver.RADIUS)
        touched = outcome.contact or outcome.walked_into
        return (
            touched or outcome.reached or outcome.seconds >= self.job.longest_s - 1e-9
        )
