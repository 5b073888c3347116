"""Entities of one world by name: what stands there, is moved, spawned or removed."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BridgeError, ConfigError, suggest
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.exact_kernels import RADIUS, SHAPE
from nics_drl_bridge.lidar.shapes import Shape, place
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.sim.device import DeviceWorld
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.sdf import Placed
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import FASTEST, Motion, check_inside
from nics_drl_bridge.sim.world_set import AnyWorld

OBSTACLE = "obstacle_"  # prefix of the name of a world's obstacle, before its number
NAME = re.compile(r"(?=.{1,120}\Z)[A-Za-z0-9_][A-Za-z0-9_./-]*")


class UnknownEntityError(BridgeError):
    """No entity has that name."""

    code = 2  # RESULT_NOT_FOUND of the standard


@dataclass(eq=False)
class Entity:
    """A robot, or one or more shapes that move as one."""

    name: str
    robot: int = -1  # index of the robot; -1 for shapes
    slots: tuple[int, ...] = ()  # indices of the bodies of its shapes
    # its shapes and their poses in the entity's own frame
    parts: tuple[Placed, ...] = ()
    # (3,) pose at which it was spawned; None if it belongs to the world
    start: Array | None = None
    motion: Motion | None = None


class Entities:
    """All entities of a device's world; even those of the world itself may be removed.

    When robots come or go, or shapes come for which the simulator has no space, `make` makes a new
    simulator, in which the episode continues. `robots` are the names of the robots that the
    simulator started with.
    """

    def __init__(
        self,
        device: DeviceWorld,
        world: AnyWorld,
        robots: tuple[str, ...],
        make: Callable[[AnyWorld, int], FastSimulator],
    ) -> None:
        self.device = device
        self.world = world
        self.robots = robots
        self.make = make
        self.removed: set[int] = set()  # slots of the world's own obstacles
        self.spawned: dict[str, Entity] = {}
        self._own = device.simulator.sampler.count
        self._launched = list(robots)
        self._spare = list[Shape]()
        # the bodies, in the order of slots
        self._table: Array = np.zeros((self._own, 7))
        device.arrange = self._arrange

    @property
    def simulator(self) -> FastSimulator:
        """The present simulator of the entities."""
        return self.device.simulator

    def _arrange(self, scenes: Scenes, starts: Array | None) -> Array:
        """Complete the scene of an episode; return the starts (1, M, 3) of all robots."""
        bodies = scenes.bodies[0]
        bodies[sorted(self.removed), RADIUS] = 0.0
        placed = scenes.starts.copy()
        if starts is not None:
            # robots of the start that are still there
            indices = [self.robots.index(name) for name in self._launched]
            placed[:, : len(indices)] = starts[:, indices]
        for entity in self.spawned.values():
            if entity.robot >= 0:
                placed[0, entity.robot] = entity.start
            else:
                self._put(bodies, entity, entity.start)
        self._table = bodies.copy()
        return placed

    def _put(self, bodies: Array, entity: Entity, pose: Array | None) -> None:
        first = len(self.simulator.sampler.shapes) - len(self._spare)
        for slot, (shape, part) in zip(entity.slots, entity.parts, strict=True):
            if slot >= self._own:
                index = first + slot - self._own
            else:
                index = bodies[slot, SHAPE]
            at = geometry.compose(np.asarray(pose), np.asarray(part))
            bodies[slot] = place(at, shape.radius, index)

    def bodies(self) -> Array:
        """Return all obstacles (K, 7) as they stand, in the order of slots."""
        if self.simulator.moves:  # in the order of the slots
            self._table = self.simulator.obstacles[0]
        return self._table

    def __iter__(self) -> Iterator[Entity]:
        yield from (Entity(name, robot=m) for m, name in enumerate(self._launched))
        sampler = self.simulator.sampler
        bodies = self.bodies()
        motions = sampler.motions[int(self.simulator.data.member[0])]
        for k in np.flatnonzero(bodies[: self._own, RADIUS] > 0.0).tolist():
            part = ((sampler.shapes[int(bodies[k, SHAPE])], (0.0, 0.0, 0.0)),)
            yield Entity(f"{OBSTACLE}{k}", slots=(k,), parts=part, motion=motions[k])
        yield from self.spawned.values()

    def find(self, name: str) -> Entity:
        """Return the entity of a name. Raises UnknownEntityError."""
        entities = {entity.name: entity for entity in self}
        if name not in entities:
            raise UnknownEntityError(
                f"there is no entity {name!r}; {suggest(name, entities)}"
            )
        return entities[name]

    def pose(self, entity: Entity) -> Array:
        """Return x, y, heading (3,) of an entity in `map`."""
        if entity.robot >= 0:
            robot_pose: Array = self.simulator.data.pose[0, entity.robot].copy()
            return robot_pose
        part = np.array(entity.parts[0][1])
        body = self.bodies()[entity.slots[0], :3]
        return geometry.compose(body, geometry.between(part, np.zeros(3)))

    def twist(self, entity: Entity) -> Array:
        """Return vx, vy [m/s], wz [rad/s] (3,) of an entity along the axes of `map`."""
        if entity.robot >= 0:
            sensed = self.device.sensed(entity.robot)
            body = textbook(self.simulator.model.robot).twist(sensed.state)
            return np.array([*geometry.rotate(body[:2], sensed.pose[2]), body[2]])
        if entity.motion is None:
            return np.zeros(3)
        moving: Array = self.simulator.data.velocity[0, entity.slots[0]].copy()
        return moving

    def move(self, entity: Entity, pose: Array | None, twist: Array | None) -> None:
        """Put an entity at a pose (3,), or give it a twist (3,) along the axes of `map`.

        A twist is limited to what the entity can do. Raises ConfigError for a twist of an entity
        that never moves, OutsideError for a pose outside.
        """
        still = entity.robot < 0 and entity.motion is None
        if still and twist is not None and twist.any():
            raise ConfigError(
                f"{entity.name!r} stands still and takes no twist; set only its pose, or a "
                "zero twist."
            )
        if pose is not None:
            check_inside("the pose", self.device.world, pose[0], pose[1])
        if entity.robot >= 0:
            self._move_robot(entity.robot, pose, twist)
            return
        if pose is not None:
            bodies = self.bodies().copy()
            self._put(bodies, entity, pose)
            self._show(bodies)
        if twist is not None and entity.motion is not None:
            bounded = twist / max(1.0, float(np.abs(twist).max()) / FASTEST)
            self.simulator.data.velocity[0, entity.slots[0]] = bounded

    def _move_robot(self, robot: int, pose: Array | None, twist: Array | None) -> None:
        simulator = self.simulator
        at = simulator.data.pose[0, robot] if pose is None else pose
        state = simulator.data.state[0, robot]
        if twist is not None:
            ahead, aside = geometry.rotate(twist[:2], -at[2])
            spec = simulator.model.robot
            command = spec.from_cmd_vel([ahead, aside, twist[2]])
            limited = np.clip(command, spec.command_low, spec.command_high)
            state = textbook(spec).target(limited)
        self.device.put(robot, np.array(at), np.array(state))

    def _show(self, bodies: Array) -> None:
        self._table = bodies
        self.simulator.put_bodies(bodies)

    def find_free_name(self, name: str) -> str:
        """Return an unused name: the given one, or the given one with a number."""
        taken = {entity.name for entity in self}
        # Names of the world's own obstacles may return with the next episode.
        taken |= {f"{OBSTACLE}{k}" for k in range(self._own)}
        free = name
        number = 1
        while free in taken:
            free = f"{name}_{number}"
            number = number + 1
        return free

    def spawn(self, name: str, parts: Sequence[Placed], pose: Array) -> Entity:
        """Add shapes, at poses (3,) in the frame of an entity that is put at a pose (3,).

        Raises OutsideError, and ConfigError for shapes that the simulator can't hold.
        """
        check_inside("the pose", self.device.world, pose[0], pose[1])
        used = {slot for entity in self.spawned.values() for slot in entity.slots}
        spare = list(self._spare)
        slots = list[int]()
        for shape, _ in parts:
            free = (
                k
                for k, spare_shape in enumerate(spare)
                if spare_shape == shape and self._own + k not in used
            )
            k = next(free, len(spare))
            if k == len(spare):
                spare.append(shape)
            used.add(self._own + k)
            slots.append(self._own + k)
        if len(spare) > len(self._spare):
            self._remake(spare, list(range(len(self.robot_names))))
        entity = Entity(
            name, slots=tuple(slots), parts=tuple(parts), start=np.array(pose)
        )
        self.spawned[name] = entity
        bodies = self.bodies().copy()
        self._put(bodies, entity, pose)
        self._show(bodies)
        return entity

    def spawn_robot(self, name: str, pose: Array) -> Entity:
        """Add a robot of the simulator's kind at a pose (3,). Raises OutsideError, ConfigError."""
        check_inside("the pose", self.device.world, pose[0], pose[1])
        count = len(self.robot_names)
        entity = Entity(name, robot=count, start=np.array(pose))
        self._remake(self._spare, list(range(count)), count + 1)
        self.spawned[name] = entity
        self._move_robot(count, pose, np.zeros(3))
        return entity

    @property
    def robot_names(self) -> list[str]:
        """Names of all robots, by their numbers."""
        names = {
            entity.robot: entity.name
            for entity in self.spawned.values()
            if entity.robot >= 0
        }
        return [*self._launched, *(names[m] for m in sorted(names))]

    def delete(self, entity: Entity) -> None:
        """Remove an entity. Raises ConfigError for the last robot."""
        kept = [m for m in range(self.device.robots) if m != entity.robot]
        if not kept:
            raise ConfigError(
                f"{entity.name!r} is the last robot; a simulator needs one."
            )
        self.spawned.pop(entity.name, None)
        if entity.robot < 0:
            self.removed |= {slot for slot in entity.slots if slot < self._own}
            bodies = self.bodies().copy()
            bodies[list(entity.slots), RADIUS] = 0.0
            self._show(bodies)
            return
        if entity.robot < len(self._launched):
            self._launched.pop(entity.robot)
        for spawned in self.spawned.values():
            spawned.robot -= int(spawned.robot > entity.robot)
        self._remake(self._spare, kept)

    def restore(self) -> None:
        """Remove all spawned entities; removed ones return with the next episode."""
        if self._spare or self.spawned or self._launched != list(self.robots):
            kept = list(range(len(self._launched)))
            self.spawned.clear()
            self._remake((), kept, len(self.robots))
            self._launched = list(self.robots)
        self.removed.clear()

    def _remake(
        self, spare: Sequence[Shape], robots: Sequence[int], count: int = 0
    ) -> None:
        """Make a simulator that keeps these robots, with `count` in all, and continue in it."""
        old = self.simulator
        bodies = self.bodies().copy()
        # A separate world, because the present simulator goes on if this one can't be made.
        new = self.make(self.world.with_spare(tuple(spare)), count or len(robots))
        slots = np.arange(new.sampler.count)
        slots[len(bodies) :] = -1
        table = np.zeros((len(slots), 7))
        table[: len(bodies)] = bodies[: len(slots)]
        # Spare shapes come last, and each has its own slot.
        new.take_over(old, np.array(robots, np.int64), slots)
        new.put_bodies(table)
        self._spare = list(spare)
        self._table = table
        self.device.exchange(new, np.array(robots, np.int64))
