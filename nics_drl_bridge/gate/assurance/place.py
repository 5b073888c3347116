"""A robot in its own world, with its driver and what happens to it.

The world advances in short steps. The robot's base reads a command once per control
period, like a slow real one.
"""

from dataclasses import dataclass, replace

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.assurance.adversaries import (
    Adversary,
    Driver,
    PolicyDriver,
    Truth,
)
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, X, Y
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import load_world

STEP_S = 0.02  # about the time between two steps of the world
ADVERSARY_S = 5.0  # length of an adversary's episode
POLICY_S = 25.0  # maximum length of a policy's episode
# A robot that moved more slowly than this over the last steps before a touch was at
# rest and was walked into [m/s]. At rest, the noise of a car moves it at up to 0.012
# m/s.
MOVING = 0.02
MOVING_STEPS = 10
POLICY = "policy"


@dataclass(frozen=True)
class Job:
    """An episode to drive."""

    kind: str  # of its driver: one of `ADVERSARIES`, or `policy`
    seed: int  # of scene and driver
    standing: bool = False  # the driver never moves

    @property
    def longest_s(self) -> float:
        """Maximum length [s]."""
        return POLICY_S if self.kind == POLICY else ADVERSARY_S


@dataclass
class Outcome:
    """Result of an episode."""

    kind: str
    robot: str
    world: str
    seed: int
    contact: bool = False  # the robot touched something while it moved
    walked_into: bool = False  # something touched it while it was at rest
    latched: str = ""  # rule by which the gate latched a stop
    reached: bool = False  # it reached its goal
    path: float = 0.0  # [m]
    seconds: float = 0.0
    speed: float = 0.0  # speed at the contact, if any [m/s]
    silence: float = 0.0  # longest silence of its gate over DDS [s]
    position: tuple[float, float] = (0.0, 0.0)  # at the end [m]


class Place:
    """A robot in a world, for consecutive episodes; its lidar scans once per period."""

    def __init__(
        self,
        model: SimulatorModel,
        world: str,
        policy: str = "dynamic_window",
        randomisation: str | None = None,
    ) -> None:
        if model.sensors:
            names = ", ".join(sensor.name for sensor in model.sensors)
            raise ConfigError(
                f"robot {model.robot.name!r} has additional sensors ({names}), which "
                "these episodes do not simulate; use a model without them."
            )
        timing = model.timing
        divisors = [
            n for n in range(1, timing.substeps + 1) if timing.substeps % n == 0
        ]
        wanted = model.control_period / STEP_S
        self.period_steps = min(divisors, key=lambda n: abs(n - wanted))
        self.step_s = model.control_period / self.period_steps
        rate = 1.0 / (self.period_steps * self.step_s)
        lidar = model.lidar.model_copy(update={"rate": rate})
        self.model = replace(model, lidar=lidar)
        self.robot = model.robot.name
        self.world = world
        self._policy = policy
        self._policy_driver: PolicyDriver | None = None
        opened = load_world(world)
        self._walls = opened.all_walls()
        self._sim = FastSimulator(
            replace(self.model, control_period=self.step_s),
            opened,
            renderer="auto",  # also correct close to an obstacle
            randomisation=randomisation,
        )
        self.odom = np.zeros(3)  # pose by odometry, continued over episodes

    def begin(self, job: Job) -> None:
        """Places the robot at rest in the scene of a job. `track` gets its true poses (3,)."""
        self.job = job
        self._steps = 0
        self.scenes = self._sim.reset([job.seed])
        self._begun = self._sim.data.odom[0, 0].copy()
        self._anchor = self.odom.copy()
        self.track = [self._sim.data.pose[0, 0].copy()]
        self.outcome = Outcome(job.kind, self.robot, self.world, job.seed)
        rng = np.random.default_rng([7, job.seed])
        self._phase = int(rng.integers(self.period_steps))
        self._command = np.zeros((1, 1, len(self.model.robot.command)))
        self._driver: Driver
        if job.kind != POLICY:
            self._driver = Adversary(job.kind, self.model, rng)
            return
        if self._policy_driver is None:
            self._policy_driver = PolicyDriver(self._policy, self.model)
        self._driver = self._policy_driver
        self._policy_driver.begin()

    @property
    def truth(self) -> Truth:
        """Returns the true state of the robot and its surroundings."""
        data = self._sim.data
        obstacles = self._sim.obstacles[0]
        return Truth(
            pose=data.pose[0, 0].copy(),
            twist=data.twist[0, 0].copy(),
            ranges=data.ranges[0, 0].copy(),
            circles=obstacles[:, [X, Y, RADIUS]],
            velocities=data.velocity[0, :, :2].copy(),
            walls=self._walls,
            goal=self._sim.goals[0, 0],
        )

    def wish(self, truth: Truth) -> Array:
        """Returns the driver's command for `cmd_vel_raw` (3,)."""
        if self.job.standing:
            return np.zeros(3)
        return self.model.robot.to_cmd_vel(self._driver.act(truth))

    def step(self, twist: Array) -> None:
        """Advances by a step while `cmd_vel` is `twist` (3,)."""
        data = self._sim.data
        outcome = self.outcome
        if (self._steps + self._phase) % self.period_steps == 0:
            self._command[0, 0] = self.model.robot.from_cmd_vel(twist)
        touched = bool(data.collided[0, 0])
        self._sim.step(self._command)
        self._steps += 1
        before = self._compute_speed()
        x, y, heading = data.pose[0, 0].tolist()
        outcome.path += float(np.hypot(*((x, y) - self.track[-1][:2])))
        self.track.append(np.array([x, y, heading]))
        outcome.seconds = self._steps * self.step_s
        outcome.position = (x, y)
        if data.collided[0, 0] and not touched:
            # The contact itself may have stopped the robot.
            outcome.speed = max(before, self._compute_speed())
            outcome.contact = outcome.speed > MOVING
            outcome.walked_into = not outcome.contact
        moved = geometry.between(self._begun, data.odom[0, 0])
        self.odom = geometry.compose(self._anchor, moved)

    def _compute_speed(self) -> float:
        """Returns the true speed over the last steps [m/s], since odometry is noisy.

        It is the speed of the centre, or that of a corner about the centre if that is
        higher.
        """
        lately = self.track[-MOVING_STEPS - 1 :]
        steps = len(lately) - 1
        if not steps:
            return 0.0
        x, y, turn = geometry.between(lately[0], lately[-1])
        distance = float(np.hypot(x, y))
        robot = self.model.robot
        if robot.footprint is not None:  # a turning circle sweeps nothing
            distance = max(distance, abs(float(turn)) * robot.footprint_radius)
        return distance / (steps * self.step_s)

    @property
    def ended(self) -> bool:
        """True if the episode is over."""
        outcome = self.outcome
        if isinstance(self._driver, PolicyDriver) and not self.job.standing:
            to_goal = self._sim.data.pose[0, 0, :2] - self._sim.goals[0, 0]
            outcome.reached = bool(np.hypot(*to_goal) < self._driver.goal_radius)
        is_over = outcome.contact or outcome.walked_into or outcome.reached
        return is_over or outcome.seconds >= self.job.longest_s - 1e-9
