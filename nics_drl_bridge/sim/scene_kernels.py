"""Compiled drawing of scenes: obstacles, starts and goals of one seed after the other.

The scene of a seed does not depend on the batch: every number is drawn from its own counter.
Obstacles are placed one after the other where they overlap nothing, then starts and goals in pairs;
if placement fails, the scene is restarted with fresh numbers. Points are drawn in the cells of a
grid that are known to be free.

Shared arguments: `static`, `outlines` and `spare` are those of `space_kernels`; `seed` and
`counter` are those of the next draw.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge import random_kernels as random
from nics_drl_bridge.kernels import kernel
from nics_drl_bridge.sim.space_kernels import (
    area_of,
    clear_of_bodies,
    clear_of_walls,
    joined,
    place_in,
)

TRIES = 2000
RESTARTS = 50
DETOURS = 4
"""Number of pairs of start and goal without a path after which the obstacles are redrawn."""
MARGIN = 1e-9
"""Least distance of obstacles from walls and from each other [m]."""
DRAWN, NO_OBSTACLES, NO_ROBOTS = 0, 1, 2
LEAST, GREATEST, GAP, FIRST_SHAPE, SHAPES, FIXED, MOVING = range(7)
"""Columns of a group."""


@kernel
def _uniform(seed, counter):  # type: ignore[no-untyped-def]
    return random.uniform(seed, random.SCENE_STREAM, counter)


@kernel
def _point(seed, counter, cells, static):  # type: ignore[no-untyped-def]
    """Draws a point in one of the cells, given by row-major indices; takes 3 counters."""
    distance, frame = static[0], static[2]
    cell = cells[int(_uniform(seed, counter) * cells.shape[0])]
    i, j = cell // distance.shape[1], cell % distance.shape[1]
    return place_in(i + _uniform(seed, counter + 1), j + _uniform(seed, counter + 2), frame)


@kernel
def _put(body, x, y, heading, shape, outlines):  # type: ignore[no-untyped-def]
    body[0], body[1], body[2] = x, y, heading
    body[3], body[4] = math.cos(heading), math.sin(heading)
    body[5], body[6] = outlines[2][shape], shape


@kernel
def _choose(seed, counter, wanted, size, plan, bodies, active):  # type: ignore[no-untyped-def]
    """Draws which obstacles exist, marked in `active` (K,), and the shape of each."""
    groups, _, base, index, _ = plan
    total, before, k = 0, 0, 0
    for g in range(groups.shape[0]):
        if groups[g, FIXED] == 0.0:
            total += int(groups[g, GREATEST])
    for g in range(groups.shape[0]):
        least, greatest = int(groups[g, LEAST]), int(groups[g, GREATEST])
        count = least + int(_uniform(seed, counter) * (greatest - least + 1))
        counter += 1
        if groups[g, FIXED] == 0.0:
            if wanted >= 0:  # each group gets its share
                asked, after = min(wanted, total), before + greatest
                count = (asked * after + total // 2) // total - (
                    (asked * before + total // 2) // total
                )
            before += greatest
        first, shapes = int(groups[g, FIRST_SHAPE]), int(groups[g, SHAPES])
        for number in range(greatest):
            taken = base[first + int(_uniform(seed, counter) * shapes)]
            counter += 1
            active[k] = number < count
            for i in range(6):
                bodies[k, i] = 1.0 if i == 3 else 0.0
            bodies[k, 6] = index[size, taken]
            k += 1
    return counter


@kernel
def _place_obstacles(  # type: ignore[no-untyped-def]
    seed, counter, plan, static, cells, outlines, bodies, active, gaps, trial, spare
):
    """Places the obstacles: first those at fixed poses, then the others."""
    groups, slot, _, _, poses = plan
    corner = outlines[1]
    for k in range(bodies.shape[0]):
        gaps[k] = max(groups[slot[k], GAP], MARGIN)
        bodies[k, 5] = 0.0
        if groups[slot[k], FIXED] > 0.0:
            _put(bodies[k], poses[k, 0], poses[k, 1], poses[k, 2], int(bodies[k, 6]), outlines)
    for k in range(bodies.shape[0]):
        if groups[slot[k], FIXED] > 0.0 or not active[k]:
            continue
        shape, heading, placed = int(bodies[k, 6]), 0.0, False
        for _ in range(TRIES):
            x, y = _point(seed, counter, cells, static)
            counter += 3
            if corner[shape] < corner[shape + 1]:
                heading = (2.0 * _uniform(seed, counter) - 1.0) * math.pi
                counter += 1
            _put(trial, x, y, heading, shape, outlines)
            if clear_of_bodies(trial, gaps[k], bodies, gaps, outlines, spare) and clear_of_walls(
                trial, MARGIN, static, outlines, spare
            ):
                _put(bodies[k], x, y, heading, shape, outlines)
                placed = True
                break
        if not placed:
            return counter, False
    return counter, True


@kernel
def _spot(seed, counter, places, cells, static):  # type: ignore[no-untyped-def]
    """Draws x, y, heading of a start or goal; takes 4 counters.

    Args:
        seed, counter: of the draw.
        places: (P, 7) x1, y1, x2, y2 of a region, least and greatest heading, cumulative share of
            the places up to this one; no rows for anywhere.
        cells: used if there are no places.
        static: see the module.
    """
    turn = _uniform(seed, counter + 3)
    if places.shape[0] == 0:
        x, y = _point(seed, counter, cells, static)
        return x, y, (2.0 * turn - 1.0) * math.pi
    share, p = _uniform(seed, counter), 0
    while p < places.shape[0] - 1 and share >= places[p, 6]:
        p += 1
    x = places[p, 0] + _uniform(seed, counter + 1) * (places[p, 2] - places[p, 0])
    y = places[p, 1] + _uniform(seed, counter + 2) * (places[p, 3] - places[p, 1])
    return x, y, places[p, 4] + turn * (places[p, 5] - places[p, 4])


@kernel
def _free(disc, x, y, rules, static, bodies, none, outlines, spare):  # type: ignore[no-untyped-def]
    """True if a robot with the clearance around it fits at a point."""
    disc[0], disc[1] = x, y
    return clear_of_bodies(disc, rules[1], bodies, none, outlines, spare) and clear_of_walls(
        disc, rules[1], static, outlines, spare
    )


@kernel
def _apart(x, y, others, m, least):  # type: ignore[no-untyped-def]
    """True if a point is farther than `least` [m] from the first m of others (M, 2 or more)."""
    for other in range(m):
        dx, dy = x - others[other, 0], y - others[other, 1]
        if dx * dx + dy * dy <= least * least:
            return False
    return True


@kernel
def _in_ring(seed, counter, x, y, least, greatest):  # type: ignore[no-untyped-def]
    """Draws a point uniformly in the ring of these distances [m] around another."""
    turn = 2.0 * math.pi * _uniform(seed, counter)
    share = _uniform(seed, counter + 1)
    far = math.sqrt(least * least + share * (greatest * greatest - least * least))
    return x + far * math.cos(turn), y + far * math.sin(turn)


@kernel
def _place_robots(  # type: ignore[no-untyped-def]
    seed, counter, rules, where, still, static, outlines, bodies, none, starts, goals, disc,
    search, spare,
):  # fmt: skip
    """Places starts and goals in pairs, each pair with a path between them."""
    start_places, goal_places, cells, _ = where
    footprint, clearance, least, greatest, room, around = rules
    for m in range(starts.shape[0]):
        placed, detours = False, 0
        for _ in range(TRIES):
            x, y, heading = _spot(seed, counter, start_places, cells, static)
            counter += 4
            area = area_of(x, y, static)
            if area == 0 or not _free(disc, x, y, rules, static, bodies, none, outlines, spare):
                continue
            if around > 0.0:
                gx, gy = _in_ring(seed, counter, x, y, least, greatest)
            else:
                gx, gy, _ = _spot(seed, counter, goal_places, cells, static)
            counter += 4
            distance2 = (gx - x) * (gx - x) + (gy - y) * (gy - y)
            if not least * least <= distance2 <= greatest * greatest:
                continue
            if area_of(gx, gy, static) != area:
                continue
            if not _free(disc, gx, gy, rules, static, bodies, none, outlines, spare):
                continue
            between = 2.0 * footprint + clearance
            if not (_apart(x, y, starts, m, between) and _apart(gx, gy, goals, m, between)):
                continue
            if not joined(
                x, y, gx, gy, disc, room - footprint, still, static, bodies, none, outlines,
                search, spare,
            ):  # fmt: skip
                detours += 1
                if detours == DETOURS:
                    break
                continue
            starts[m, 0], starts[m, 1], starts[m, 2] = x, y, heading
            goals[m, 0], goals[m, 1] = gx, gy
            placed = True
            break
        if not placed:
            return counter, False
    return counter, True


@kernel(allocates=True)
def draw_scenes(  # type: ignore[no-untyped-def]
    seeds, wanted, sizes, plan, static, outlines, rules, where, bodies, starts, goals, search
):
    """Draws the scenes of some seeds.

    Args:
        seeds: (n,).
        wanted: (n,) number of random obstacles, -1 for the world's own.
        sizes: (n,) rows of the shapes' index.
        plan: groups (G, 7), group of each obstacle (K,), shapes that each group may take, one
            group after the other, index (S, H) of each shape in each size, poses (K, 3) of the
            obstacles at fixed poses.
        static, outlines: see the module.
        rules: footprint and clearance [m], least and greatest distance of the goal [m], free space
            required at the centre of a cell [m], 1 to draw goals around their starts.
        where: places of starts and of goals, see `_spot`; cells free for robots, and cells with
            any free space.
        bodies: (n, K, 7) result, see `lidar.shapes.BODY`.
        starts: (n, M, 3) result.
        goals: (n, M, 2) result.
        search: scratch, see `joined`.

    Returns:
        The first row that could not be drawn, or n, and the reason.
    """
    count = bodies.shape[1]
    gaps, none = np.zeros(count), np.zeros(count)
    active, still = np.zeros(count, np.bool_), np.zeros(count, np.uint8)
    disc, trial = np.zeros(7), np.zeros(7)
    corner = outlines[1]
    most = 4
    for h in range(corner.shape[0] - 1):
        most = max(most, corner[h + 1] - corner[h])
    spare = np.zeros((most, 2))
    disc[3], disc[5], disc[6] = 1.0, rules[0], corner.shape[0] - 2
    for k in range(count):
        still[k] = plan[0][plan[1][k], MOVING] == 0.0
    for n in range(seeds.shape[0]):
        state = NO_OBSTACLES
        counter = _choose(seeds[n], 0, wanted[n], sizes[n], plan, bodies[n], active)
        for _ in range(RESTARTS):
            counter, placed = _place_obstacles(
                seeds[n], counter, plan, static, where[3], outlines, bodies[n], active, gaps,
                trial, spare,
            )  # fmt: skip
            if placed:
                state = NO_ROBOTS
                counter, placed = _place_robots(
                    seeds[n], counter, rules, where, still, static, outlines, bodies[n], none,
                    starts[n], goals[n], disc, search, spare,
                )  # fmt: skip
            if placed:
                state = DRAWN
                break
        if state != DRAWN:
            return n, state
    return seeds.shape[0], DRAWN
