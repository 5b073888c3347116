"""The surroundings of the worlds of a set, stacked for the kernels, and of one of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.files import sha256
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.lidar.exact_kernels import OutlineArrays
from nics_drl_bridge.lidar.fixtures import cells_of, joined, stack_fixtures, walls_of
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.sim.obstacles import Motion, plan_arrays
from nics_drl_bridge.sim.separation_kernels import FIRST, PLAN
from nics_drl_bridge.sim.state import NO_FIELD, Array, MapField, Members, Movers, Surroundings
from nics_drl_bridge.sim.world import World


@kernel(view=True)
def surroundings_of(n: int, members: Members) -> Surroundings:
    """Returns all that stands in world n of the simulation."""
    p = members.fixtures.member[n]
    frame = members.fixtures.frames[p]
    distances = cells_of(members.distances, members.fields[p])
    grid = MapField(distances, frame[0], frame[1], frame[2], frame[3], frame[4])
    movers = Movers(members.moves, members.plans[p], members.waypoints, members.field[p])
    return Surroundings(
        walls_of(n, members.fixtures), grid, members.outlines, members.crowded,
        members.scattered, movers,
    )  # fmt: skip


def members_of(
    worlds: Sequence[World], motions: Sequence[Sequence[Motion | None]], outlines: OutlineArrays,
    crowds: tuple[bool, bool], member: NDArray[np.int64],
) -> Members:  # fmt: skip
    """Stacks P worlds, of up to K obstacles that move by `motions` (P, K), for N copies.

    `crowds` are `Surroundings.crowded` and `scattered`; `member` (N,) is read as the kernels run.
    """
    grids = _shared([world.grid for world in worlds])
    distances, places = joined([map_field(grid).distances for grid in grids])
    moves = any(motion is not None for each in motions for motion in each)
    plans, waypoints = _plans(motions if moves else [() for _ in worlds])
    field = np.array([world.extent for world in worlds])
    return Members(
        stack_fixtures([world.all_walls() for world in worlds], grids, member), distances, places,
        outlines, *crowds, moves, plans, waypoints, field,
    )  # fmt: skip


def _shared(grids: Sequence[GridMap | None]) -> list[GridMap | None]:
    """The same object for maps of the same content, which is then baked and stored once."""
    once: dict[Any, GridMap] = {}
    found: list[GridMap | None] = []
    for grid in grids:
        if grid is None:
            found.append(None)
        else:
            about = grid.cells.shape, grid.resolution, grid.origin, sha256(grid.cells.tobytes())
            found.append(once.setdefault(about, grid))
    return found


def map_field(grid: GridMap | None) -> MapField:
    """Returns a static map as the kernels take it."""
    if grid is None:
        return NO_FIELD
    return MapField(np.ascontiguousarray(grid.distance_field), *grid.arrays.frame.tolist())


def _plans(motions: Sequence[Sequence[Motion | None]]) -> tuple[Array, Array]:
    each = [plan_arrays(one) for one in motions]
    plans = np.zeros((len(each), max(map(len, motions)), PLAN))
    first = 0
    for into, (rows, waypoints) in zip(plans, each, strict=True):
        into[: len(rows)] = rows
        into[:, FIRST] += first
        first += len(waypoints)
    return plans, np.concatenate([waypoints for _, waypoints in each])
