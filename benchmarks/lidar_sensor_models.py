"""Does a sensor model that is baked in slow rendering down?

The mixture of Table II, 720 beams to 3 m among ten obstacles, on one thread. Ranges are rendered
from a table without a model, and with each of some models; all of them in turn, in one run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from measuring.rates import interleaved, medians, shortest
from measuring.scenes import BATCH, SCENES, SPEC, random_batch
from measuring.verdict import answer, parser_of

from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.sensor_models import IncidenceDropout, Intensity, SensorModel
from nics_drl_bridge.lidar.table import Density

CONTROLS = {
    "plain": "tables without a sensor model in place of those with one",
    "slow": "each scan of a table with a sensor model is made twice",
}
DROPOUT = IncidenceDropout(greatest_incidence=1.3)
BRIGHT = Intensity(threshold=0.02)
MODELS: dict[str, tuple[SensorModel, ...]] = {
    "no model": (),
    "incidence dropout": (DROPOUT,),
    "intensity": (BRIGHT,),
    "both": (DROPOUT, BRIGHT),
}
SHAPES = SCENES["mixture"]
BAR, NOISY = 1.05, 1.5
"""Times as long as without a model: what is told, and what is missed, as a machine that does other
work at the same time lends more to one than to another."""


def calls_of(
    density: Density, scans: int, control: str | None
) -> tuple[dict[str, Callable[[], object]], dict[str, int], dict[str, int]]:
    """What is timed, by name: ranges of each table.

    Also bytes of each table, and how many beams return.
    """
    batch = random_batch(SHAPES, scans, 0)
    calls = {}
    sizes = {}
    returns = {}
    out = np.empty((scans, SPEC.beams), np.float32)
    for name, model in MODELS.items():
        baked = () if control == "plain" else model
        scanner = Scanner(SPEC, bake(SPEC, SHAPES, density, baked), "baked")
        bodies = batch.bodies(scanner)
        sizes[name] = scanner.table.memory
        calls[name] = partial(scanner.scan, batch.lidar, bodies, out=out)
        returns[name] = int(np.isfinite(calls[name]()).sum())
        if control == "slow" and model:
            calls[name] = partial(twice, calls[name])
    return calls, sizes, returns


def twice(call: Callable[[], object]) -> None:
    """Calls twice."""
    call()
    call()


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = [
        f"{name}: {result['times_as_long_median'][name]:.2f} times as long, bar {NOISY:g}"
        for name in MODELS
        if not min(
            result[key][name] for key in ("times_as_long", "times_as_long_median")
        )
        <= NOISY
    ]
    plain = result["returns"]["no model"]
    missed += [
        f"{name}: {result['returns'][name]} beams return, bar fewer than the {plain} without"
        for name, model in MODELS.items()
        if model and not 0 < result["returns"][name] < plain
    ]
    return missed


def run(
    scans: int, repeats: int, density: Density, control: str | None
) -> dict[str, Any]:
    """All figures, see the head of this file."""
    calls, sizes, returns = calls_of(density, scans, control)
    times = interleaved(calls, repeats, warm=True)
    least = shortest(times)
    middle = medians(times)
    plain = "no model"
    return {
        "scans_per_s": {name: scans / each for name, each in least.items()},
        "times_as_long": {name: each / least[plain] for name, each in least.items()},
        "times_as_long_median": {
            name: each / middle[plain] for name, each in middle.items()
        },
        "table_bytes": sizes,
        "returns": returns,
        "bar_met": max(least[name] for name in MODELS) <= BAR * least[plain],
    }


def table_of(result: dict[str, Any]) -> str:
    """The figures for people."""
    row = "{:<24}{:>11}{:>16}{:>16}{:>11}\n"
    text = row.format("", "scans/s", "times as long", "by the median", "table")
    for name, rate in result["scans_per_s"].items():
        ratios = (result["times_as_long"][name], result["times_as_long_median"][name])
        size = result["table_bytes"].get(name)
        text += row.format(
            name,
            f"{rate:.2e}",
            *(f"{ratio:.3f}" for ratio in ratios),
            "" if size is None else f"{size / 1e6:.1f} MB",
        )
    met = "met" if result["bar_met"] else "missed"
    return text + f"ranges with any model, bar {BAR} times as long: {met}\n"


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--scans", type=int, default=BATCH, help="scans of a batch")
    parser.add_argument("--repeats", type=int, default=200, help="timed batches")
    parser.add_argument(
        "--distances", type=int, default=100, help="grid distances of the table"
    )
    parser.add_argument(
        "--rotations", type=int, default=240, help="grid rotations of the table"
    )
    given = parser.parse_args()
    density = Density(distances=given.distances, rotations=given.rotations)
    result = run(given.scans, given.repeats, density, given.control)
    answer(result, missed_of(result), table_of(result), given.json)


if __name__ == "__main__":
    main()
