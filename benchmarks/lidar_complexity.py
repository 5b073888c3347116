"""Does the cost of a scan depend on how complicated the obstacles are?

Ten polygons of 4 to 4,096 vertices around a lidar of 720 beams: five are convex, five are
stars, all of the same size (the hull has the same perimeter, so they cover as many beams
on average).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.rates import interleaved, shortest
from measuring.scenes import BATCH, SPEC, random_batch

from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Polygon, Shape, convex_hull
from nics_drl_bridge.lidar.table import Density

CONTROLS = {"exact": "the exact scanner in place of the baked one"}
VERTICES = tuple(2**power for power in range(2, 13))
PERIMETER = 2.0 * np.pi * 0.2
BAR = 1.5
FASTER = 3.0
WORK = 2**15
"""Vertices that an exact batch visits per obstacle; it bounds how long a batch takes."""


@dataclass(frozen=True)
class Scans:
    """A call that scans a batch, and how many scans that is."""

    call: Callable[[], object]
    size: int


def polygon(vertices: int, seed: int, notch: float) -> Polygon:
    """A random polygon: convex with `notch` 0, a star whose corners lie up to that deep inside."""
    rng = np.random.default_rng([seed, vertices])
    angles = (
        2.0
        * np.pi
        / vertices
        * (np.arange(vertices) + rng.uniform(-0.3, 0.3, vertices))
    )
    depth = 1.0 - notch * rng.random(vertices)
    points = depth[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    hull = convex_hull(points)
    points *= PERIMETER / np.hypot(*(hull - np.roll(hull, 1, axis=0)).T).sum()
    return Polygon(points=tuple((float(x), float(y)) for x, y in points))


def scans_of(
    shapes: tuple[Shape, ...],
    density: Density,
    scans: int,
    control: str | None,
) -> dict[str, Scans]:
    """A batch of scans, exact and baked."""
    table = bake(SPEC, shapes, density)
    corners = max(1, int(np.diff(table.outlines.corner).mean()))
    sizes = {"exact": min(scans, max(8, WORK // corners)), "baked": scans}
    batch = random_batch(shapes, scans, 0)
    result = {}
    for name, size in sizes.items():
        scanner = Scanner(SPEC, table, "exact" if control == "exact" else name)
        lidar = batch.lidar[:size]
        bodies = batch.bodies(scanner)[:size]
        out = np.empty((size, SPEC.beams), np.float32)
        result[name] = Scans(partial(scanner.scan, lidar, bodies, out=out), size)
    return result


def costs(
    subjects: Mapping[str, tuple[Shape, ...]],
    density: Density,
    scans: int,
    repeats: int,
    control: str | None,
) -> dict[str, dict[str, float]]:
    """Time of one scan [us] by subject, exact and baked: the shortest, all of them in turn."""
    drawn = {
        (name, way): some
        for name, shapes in subjects.items()
        for way, some in scans_of(shapes, density, scans, control).items()
    }
    calls = {key: some.call for key, some in drawn.items()}
    seconds = shortest(interleaved(calls, repeats, warm=True))
    found: dict[str, dict[str, float]] = {name: {} for name in subjects}
    for (name, way), each in seconds.items():
        found[name][way] = 1e6 * each / drawn[name, way].size
    return found


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    ratio = result["baked_end_to_end"]
    if not ratio <= BAR:
        missed.append(
            f"baked costs {ratio:.2f} times as much with other vertices, bar {BAR:g}"
        )
    exact = result["exact_us"][-1]
    baked = result["baked_us"][-1]
    if not exact >= FASTER * baked:
        missed.append(
            f"at {result['vertices'][-1]} vertices exact takes {exact / baked:.2f} times as long "
            f"as baked, bar {FASTER:g}"
        )
    return missed


def run(
    most: int, scans: int, repeats: int, density: Density, control: str | None
) -> dict[str, Any]:
    """All figures, see the head of this file."""
    vertices = [count for count in VERTICES if count <= most]
    many = {
        str(count): (polygon(count, 0, 0.0), polygon(count, 1, 0.5))
        for count in vertices
    }
    measured = costs(many, density, scans, repeats, control)
    baked = [each["baked"] for each in measured.values()]
    return {
        "vertices": vertices,
        "exact_us": [each["exact"] for each in measured.values()],
        "baked_us": baked,
        "baked_end_to_end": max(baked) / min(baked),
    }


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--most", type=int, default=VERTICES[-1], help="vertices to end with"
    )
    parser.add_argument("--scans", type=int, default=BATCH, help="scans of a batch")
    parser.add_argument("--repeats", type=int, default=60, help="timed batches")
    parser.add_argument(
        "--distances", type=int, default=100, help="grid distances of the table"
    )
    parser.add_argument(
        "--rotations", type=int, default=240, help="grid rotations of the table"
    )
    given = parser.parse_args()
    density = Density(distances=given.distances, rotations=given.rotations)
    result = run(given.most, given.scans, given.repeats, density, given.control)
    answer(result, missed_of(result), given.json)


if __name__ == "__main__":
    main()
