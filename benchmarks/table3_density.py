"""The paper's Table III: what does a sparser table cost, in distance or in rotation?

RMSE of the scanned area against the exact scanner, in the four scenes of Table II, for our
look-up and, as `nearest_row`, for the paper's plain one on the same grid.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.scenes import SCENES, SPEC, batches, errors, nearest_row, scan

from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.table import Density

CONTROLS = {
    "plain": "the plain look-up in place of ours",
    "nan": "one range of the baked scans is none",
}
DENSITIES = ((100, 240), (50, 240), (100, 120))
PAPER_FACTOR = 3.47
"""What half the distances cost on average, by the paper's text."""
PART, LITTLE, MUCH = 1.0 / 3.0, 1.3, 1.3
"""Bars: part of the nearest row's error; times as bad that ours may get by half the distances or
rotations; and that a plain look-up gets by half the distances at least, as the paper says."""


def measure(name: str, scans: int, control: str | None) -> dict[str, dict[str, float]]:
    """RMSE of the area in one scene [m^2], by renderer and density."""
    drawn = batches(SCENES[name], scans)
    found: dict[str, dict[str, float]] = {"ours": {}, "nearest_row": {}}
    exact = None
    for distances, rotations in DENSITIES:
        table = bake(
            SPEC, SCENES[name], Density(distances=distances, rotations=rotations)
        )
        exact = exact or [scan(table, "exact", batch) for batch in drawn]
        key = f"{distances}x{rotations}"
        baked = [scan(table, "baked", batch) for batch in drawn]
        if control == "nan":
            baked[0][0, 0] = np.nan
        plain = [scan(table, "exact", nearest_row(batch, table)) for batch in drawn]
        baked = plain if control == "plain" else baked
        found["ours"][key] = errors(baked, exact)[1]
        found["nearest_row"][key] = errors(plain, exact)[1]
    return found


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    for distances, rotations in DENSITIES:
        key = f"{distances}x{rotations}"
        for name in SCENES:
            ours = result[key][name]
            plain = result["nearest_row"][key][name]
            if not ours <= PART * plain:
                missed.append(
                    f"{name}, {key}: {ours:.4f} m2, bar a third of {plain:.4f}"
                )
    ours, plain = (result["times_worse"][way] for way in ("ours", "nearest_row"))
    missed += [
        f"ours gets {factor:.2f} times worse at {key}, bar {LITTLE:g}"
        for key, factor in ours.items()
        if not factor <= LITTLE
    ]
    half = f"{DENSITIES[1][0]}x{DENSITIES[1][1]}"
    if not plain[half] >= MUCH:
        missed.append(
            f"a plain look-up gets {plain[half]:.2f} times worse at {half}, bar {MUCH:g}"
        )
    return missed


def run(scans: int, control: str | None) -> dict[str, Any]:
    """Area RMSE by density and scene, and by how much a sparser table is worse on average."""
    found = {name: measure(name, scans, control) for name in SCENES}
    keys = [f"{distances}x{rotations}" for distances, rotations in DENSITIES]
    tables = {
        way: {key: {name: found[name][way][key] for name in SCENES} for key in keys}
        for way in ("ours", "nearest_row")
    }
    factors = {
        way: {
            key: float(
                np.mean([each[key][name] / each[keys[0]][name] for name in SCENES])
            )
            for key in keys[1:]
        }
        for way, each in tables.items()
    }
    return {
        **tables["ours"],
        "nearest_row": tables["nearest_row"],
        "times_worse": factors,
        "scans_per_scene": scans,
    }


def table_of(result: dict[str, Any]) -> str:
    """The figures for people."""
    row = "{:<13}{:<10}" + "{:>11}" * len(SCENES) + "{:>14}\n"
    text = row.format("area [m2]", "density", *SCENES, "times worse")
    for way, tables in (("ours", result), ("nearest_row", result["nearest_row"])):
        for distances, rotations in DENSITIES:
            key = f"{distances}x{rotations}"
            factor = result["times_worse"][way].get(key)
            errors_ = [f"{tables[key][name]:.2e}" for name in SCENES]
            text += row.format(
                way, key, *errors_, "" if factor is None else f"{factor:.2f}"
            )
    return (
        text
        + f"paper: half the distances cost {PAPER_FACTOR} times, half the rotations little\n"
    )


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--scans", type=int, default=4096, help="scans of each scene")
    given = parser.parse_args()
    result = run(given.scans, given.control)
    answer(result, missed_of(result), given.json, table_of(result))


if __name__ == "__main__":
    main()
