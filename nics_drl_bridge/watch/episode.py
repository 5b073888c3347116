"""Episodes in process: a policy or a person at the keyboard drives in one or several worlds."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import wrap_angle
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, SHAPE, X, Y
from nics_drl_bridge.lidar.shapes import Circle, Rectangle, Shape
from nics_drl_bridge.policy.file.stateful import Policy, begin
from nics_drl_bridge.policy.planners.twists import scale_to_actions
from nics_drl_bridge.policy.policies import POLICIES, list_shipped_policies
from nics_drl_bridge.seeds import check_seeds
from nics_drl_bridge.sim.scenes import scaled
from nics_drl_bridge.sim.world import Obstacles, World, check_place
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds
from nics_drl_bridge.watch.frame import Frame, Stage, Track, WorldFrame
from nics_drl_bridge.watch.server import Request

Env = gymnasium.Env[Any, Any]
# makes the env and the policy, given the policy's name and a world; see `open_env`
Make = Callable[[str, AnyWorld], tuple[Env, Policy]]
HELD_S = 0.5  # the robot stops after this time without a keyboard request [s]
LINGER_S = 1.0  # simulated time between two episodes [s]
CAN = frozenset(
    {
        "goal",
        "obstacle",
        "clear",
        "policy",
        "world",
        "seed",
        "restart",
        "pause",
        "speed",
        "step",
    }
)


class Lane:
    """One world, in which episodes are driven one after another."""

    def __init__(self, make: Make, policy: str, world: AnyWorld, seed: int) -> None:
        self._make = make
        self._policy = policy
        self.trail = Track()
        self.seed = seed
        self._original_world = world  # without changes by the user
        self._open(policy, world)
        self.begin()

    def _open(self, policy: str, world: AnyWorld) -> None:
        self._env, self._driver = self._make(policy, world)
        self._policy = policy
        self.world = world
        self.env: BridgeEnv = self._env.unwrapped  # type: ignore[assignment]

    @property
    def task(self) -> Navigation:
        """The task of the policy."""
        return self.env.task  # type: ignore[return-value]

    @property
    def over(self) -> bool:
        """True once the end of the episode has been shown for a while."""
        return self._over_s >= LINGER_S

    def begin(self, **options: Any) -> None:
        """Starts the episode of the seed, with options of `reset`."""
        self._observation, _ = self._env.reset(seed=self.seed, options=options)
        begin(self._driver)
        self.state = ""
        self._over_s = 0.0
        if not options:  # with options, the episode continues
            self.time_s = 0.0
            self.trail = Track()
        self.trail.add(self.env.snapshot().poses, 1)

    def advance(self, command: NDArray[np.float64] | None) -> bool:
        """Advances one period by a command (C,) or the policy; returns True if the env is new."""
        if self.over:
            return self.restart(self.seed + 1)
        if self.state:
            self._over_s += self.env.model.control_period
            return False
        action: Any
        if command is None:
            action = self._driver.act(self._observation)
        elif self.task.actions == "discrete":
            differences = np.abs(self.task.discrete_commands - command)
            action = int(differences.sum(axis=-1).argmin())
        else:
            action = scale_to_actions(self.task, command)
        self._observation, _, terminated, truncated, info = self._env.step(action)
        self.time_s += self.env.model.control_period
        self.trail.add(self.env.snapshot().poses, 1)
        if terminated or truncated:
            if np.all(info.get("is_success", False)):
                self.state = "success"
            elif np.any(info.get("collision", False)):
                self.state = "collision"
            else:
                self.state = "time-out"
        return False

    def restart(self, seed: float, world: AnyWorld | None = None) -> bool:
        """Starts the episode of a seed in the original or another world.

        Returns True if the env is new. Raises ConfigError for a bad seed.
        """
        self.seed = int(check_seeds([seed])[0])
        self._original_world = world or self._original_world
        changed = self.world is not self._original_world
        if changed:
            self.close()
            self._open(self._policy, self._original_world)
        self.begin()
        return changed

    def aim(self, x: float, y: float) -> None:
        """Moves the goal [m]; continues after a success. Raises ConfigError off the field."""
        check_place("goal", self.env.world.members[self.env.snapshot().member], x, y)
        self.env.memory["goal"][...] = x, y
        if self.state == "success":
            self.rebuild()

    def add(self, request: Request) -> None:
        """Adds an obstacle. Raises ConfigError if it touches a robot or is off the field."""
        x = request.x
        y = request.y
        shape: Shape = Circle(radius=request.size)
        if request.shape != "circle":
            shape = Rectangle(size=(2.0 * request.size, 2.0 * request.size))
        reach = shape.radius + self.env.model.robot.footprint_radius
        distances = np.linalg.norm(self.env.snapshot().poses[:, :2] - (x, y), axis=1)
        if distances.min() <= reach:
            raise ConfigError(
                f"an obstacle at ({x:.2f} m, {y:.2f} m) touches the robot; move it."
            )
        self.rebuild("", Obstacles(shapes=(shape,), at=((x, y, 0.0),)))

    def rebuild(
        self, policy: str = "", *more: Obstacles, emptied: bool = False
    ) -> None:
        """Continues from here in a new env, with another policy or other obstacles.

        If that fails, the old env and everything else about the lane are restored.
        """
        shot = self.env.snapshot()
        kept = dict(vars(self))
        world = copy_world(self.env, *more, emptied=emptied)
        try:
            self._open(policy or self._policy, world)
            self.begin(start=shot.poses[0], goal=shot.goals[0])
        except BaseException:
            vars(self).update(kept)
            raise
        kept["_env"].close()

    def frame(self, place: int) -> WorldFrame:
        """Returns the current frame; `place` is the index of the world's first member."""
        shot = self.env.snapshot()
        name = f"{self.world.name}, episode {self.seed}"
        return WorldFrame(
            shot, name, place + shot.member, self.trail.paths, self.state, self.time_s
        )

    def close(self) -> None:
        """Closes the env."""
        self._env.close()


def copy_world(env: BridgeEnv, *more: Obstacles, emptied: bool = False) -> World:
    """Returns an env's world with `more` obstacles, and its current ones unless `emptied`."""
    shot = env.snapshot()
    world = env.world.members[shot.member]
    shapes = env.world.shapes
    groups = list(more)
    motions = [
        group.motion for group in world.obstacles for _ in range(group.counts[1])
    ]
    for body, motion in zip(shot.bodies, motions, strict=False):
        if body[RADIUS] > 0.0 and not emptied:
            shape = shapes[int(body[SHAPE]) % len(shapes)]
            shape = scaled(shape, round(float(body[RADIUS]) / shape.radius, 6))
            pose = float(body[X]), float(body[Y]), float(wrap_angle(body[HEADING]))
            groups.append(Obstacles(shapes=(shape,), at=(pose,), motion=motion))
    return world.model_copy(update={"obstacles": tuple(groups)})


class EpisodeSource:
    """Drives episodes in one world or several at once. Raises BridgeError."""

    def __init__(
        self,
        make: Make,
        policy: str,
        worlds: Sequence[AnyWorld],
        seed: int,
        model_name: str = "",
    ) -> None:
        self._model_name = model_name
        self._first = seed
        self._given_policy = policy
        self._given_worlds = {world.name: world for world in worlds}
        self.lanes = [Lane(make, policy, world, seed) for world in worlds]
        self.model = self.lanes[0].env.model
        self.period_s = self.model.control_period
        self._policy = policy
        robot = self.model.robot
        self._drives = robot.takes_cmd_vel
        self._command = 0.0 * robot.command_low
        self._by_hand = False
        self._asked_s = 0.0

    def stage(self) -> Stage:
        """See `show.FrameSource`."""
        robot = self.model.robot.name
        first = self.lanes[0].world.name
        fitting = [name for name in list_shipped_policies() if name == robot]
        can = CAN | {"drive"} if self._drives else CAN
        policies = dict.fromkeys(
            [self._policy, self._given_policy, *fitting, *POLICIES]
        )
        worlds = dict.fromkeys([first, *self._given_worlds, *list_shipped("worlds")])
        return Stage(
            f"{self._policy} in {', '.join(lane.world.name for lane in self.lanes)}",
            self.model,
            tuple(lane.env.world for lane in self.lanes),
            can,
            {"policy": list(policies), "world": list(worlds)},
            {"policy": self._policy, "world": first},
            model_name=self._model_name,
        )

    def frame(self) -> Frame:
        """See `show.FrameSource`."""
        sizes = [len(lane.env.world.members) for lane in self.lanes]
        worlds = [lane.frame(sum(sizes[:n])) for n, lane in enumerate(self.lanes)]
        return Frame(self.lanes[0].time_s, tuple(worlds))

    def advance(self) -> bool:
        """Advances all worlds by one control period; see `show.FrameSource`."""
        command = None
        if self._by_hand:
            is_held = time.monotonic() - self._asked_s < HELD_S
            command = self._command if is_held else 0.0 * self._command
        changed = [lane.advance(command) for lane in self.lanes]
        return any(changed)

    def take(self, request: Request) -> bool:
        """See `show.FrameSource`."""
        lane = self.lanes[min(request.world, len(self.lanes) - 1)]
        kind = request.kind
        if kind == "goal":
            lane.aim(request.x, request.y)
        elif kind == "drive":
            self._drive(request)
        elif kind == "obstacle":
            lane.add(request)
        elif kind == "clear":
            lane.rebuild(emptied=True)
        elif kind == "world":
            world = self._given_worlds.get(request.name)
            lane.restart(lane.seed, world or load_worlds(request.name))
        elif kind == "policy":
            for lane in self.lanes:
                lane.rebuild(request.name)
            self._policy = request.name
        elif kind in ("seed", "restart"):
            for lane in self.lanes:
                lane.restart(lane.seed if kind == "restart" else request.value)
        return kind not in ("goal", "drive", "seek")

    def unfinished(self, episodes: int) -> bool:
        """Returns True until this many episodes have been driven and shown in every world."""
        return any(
            lane.seed < self._first + episodes - 1 or not lane.over
            for lane in self.lanes
        )

    def _drive(self, request: Request) -> None:
        """Begins or ends driving by hand, with fractions of the maximum speeds as the command."""
        robot = self.model.robot
        if not self._drives:
            raise ConfigError(
                f"robot {robot.name!r} takes no cmd_vel, so the keyboard can't drive "
                "it."
            )
        fractions = np.clip(
            np.array(request.twist)[list(robot.cmd_vel_places)], -1.0, 1.0
        )
        ends = np.where(fractions < 0.0, robot.command_low, robot.command_high)
        self._command = np.clip(
            np.abs(fractions) * ends, robot.command_low, robot.command_high
        )
        self._by_hand = request.on
        self._asked_s = time.monotonic()

    def close(self) -> None:
        """Closes all envs."""
        for lane in self.lanes:
            lane.close()
