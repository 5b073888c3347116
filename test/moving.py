"""A field in which obstacles move, and all that can be seen of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.shapes import place
from nics_drl_bridge.sim import obstacle_kernels as kernels
from nics_drl_bridge.sim.state import MARK, NO_FIELD, State, Surroundings
from nics_drl_bridge.sim.world import plan_arrays

PERIOD = 0.1


@dataclass(frozen=True)
class Watched:
    """Of every period, in one world: K obstacles, M robots.

    Attributes:
        places: (T + 1, K + M, 2) where the bodies were [m].
        headings: (T + 1, K) of the obstacles.
        velocities: (T, K, 3).
        marks: (T, K) of `state.MARK`.
    """

    places: np.ndarray
    headings: np.ndarray
    velocities: np.ndarray
    marks: np.ndarray

    @property
    def speeds(self) -> np.ndarray:
        return np.hypot(self.velocities[..., 0], self.velocities[..., 1])

    def gaps(self, radii) -> np.ndarray:
        """(T + 1, pairs) between the surfaces of an obstacle and any other body."""
        bodies = self.places.shape[1]
        count = self.velocities.shape[1]
        one, other = np.triu_indices(bodies, 1)
        other = other[one < count]
        one = one[one < count]
        away = np.linalg.norm(self.places[:, one] - self.places[:, other], axis=-1)
        return away - (np.asarray(radii)[one] + np.asarray(radii)[other])


def sides(half):
    x, y = half
    return np.array([(-x, -y, x, -y), (x, -y, x, y), (x, y, -x, y), (-x, y, -x, -y)])


def scattered(radii, half, rng, walls=None, free=0.05):
    """Places (len(radii), 2) at which nothing touches."""
    found = []
    for k, radius in enumerate(radii):
        while True:
            at = rng.uniform(-1.0, 1.0, 2) * (np.asarray(half) - radius - free)
            clear = all(
                np.linalg.norm(at - other) > radius + radii[j] + free
                for j, other in enumerate(found)
            )
            for wall in () if walls is None else walls:
                one, other = np.reshape(wall, (2, 2))
                share = np.clip(
                    (at - one) @ (other - one) / np.sum((other - one) ** 2), 0.0, 1.0
                )
                clear &= (
                    np.linalg.norm(at - one - share * (other - one)) > radius + free
                )
            if clear:
                found.append(at)
                break
        assert len(found) == k + 1
    return np.array(found)


def state_of(bodies, marks, velocity, seeds):
    """The state of N worlds as far as obstacles read and write it."""
    worlds = len(bodies)
    none = np.zeros((len(bodies), 0, 3))
    ints = np.zeros((worlds, 0), np.int64)
    empty = np.zeros((worlds, 0, 0, 0))
    return State(
        pose=none,
        state=none,
        history=empty,
        bodies=bodies,
        odom=none,
        twist=none,
        ranges=none.astype(np.float32),
        collided=ints.astype(np.uint8),
        steps=np.zeros(worlds, np.int64),
        seeds=np.array(seeds, np.int64),
        member=np.zeros(worlds, np.int64),
        faults=none,
        coefficient=none,
        delay=ints,
        age=ints,
        noise=none,
        velocity=velocity,
        past=empty,
        marks=marks,
    )


def surroundings_of(motions, half, walls, grid=NO_FIELD):
    """A field in which obstacles move."""
    outlines = OutlineArrays(np.zeros((0, 2)), np.zeros(2, np.int64))
    field = np.concatenate([np.negative(half), half]).astype(np.float64)
    plans = plan_arrays(motions)
    return Surroundings(walls, grid, outlines, False, False, *plans, field)


def watch(
    motions,
    places,
    radii,
    half=(3.0, 3.0),
    steps=2000,
    seed=1,
    walls=None,
    grid=NO_FIELD,
    robots=None,
):
    """Lets the first K of the bodies move, see `Watched`, and `robots` (T, M, 2) the others."""
    count = len(motions)
    poses = np.concatenate([places, np.zeros((len(places), 1))], axis=1)[None]
    bodies = place(poses, np.asarray(radii)[None], np.zeros((1, len(places))))
    marks = np.zeros((1, count), MARK)
    velocity = np.zeros((1, count, 3))
    walls = sides(half) if walls is None else np.concatenate([sides(half), walls])
    state = state_of(bodies, marks, velocity, [seed])
    seen = []
    scene = surroundings_of(motions, half, walls, grid)
    still = np.zeros((len(places) - count, 2))
    kernels.reset_marks(0, state, scene.plans)
    where = [bodies[0, :, :2].copy()]
    headings = [bodies[0, :count, 2].copy()]
    for t in range(steps):
        speeds = still if robots is None else robots[t]
        state.steps[0] = t
        kernels.steer(0, state, scene, PERIOD, speeds)
        bodies[0, :count, :3] += velocity[0] * PERIOD
        bodies[0, count:, :2] += speeds * PERIOD
        where.append(bodies[0, :, :2].copy())
        headings.append(bodies[0, :count, 2].copy())
        seen.append((velocity[0].copy(), marks[0].copy()))
    velocities, remembered = (np.array(part) for part in zip(*seen, strict=True))
    return Watched(np.array(where), np.array(headings), velocities, remembered)
