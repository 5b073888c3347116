"""The paper's Table II: how fast and how exact is the baked lidar among ten obstacles?

720 beams, 3 m, batches of 1,024 scans in float32 on one thread, the table at the paper's density.
Errors are against the exact scanner, with no return counted as the greatest range.
`nearest row` is the paper's plain look-up on the same grid and scenes, `write limit` the rate
at which the output array can merely be filled, measured in turn with the scanners. `--lidar` takes
another lidar, as `hokuyo_ust_10lx`, without its faults, by the same bars.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.rates import interleaved, medians
from measuring.scenes import SCENES, Batch, batches, errors, nearest_row, scan

from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.lidar.table import Density, LidarTable

CONTROLS = {
    "coarse": "a table of 3 distances and 8 rotations",
    "nan": "one range of the baked scans is none",
    "slow": "the exact scanner in place of the baked one, and each scan twice",
}
DENSITY = Density(distances=100, rotations=240)
PAPER = {  # scan mode [1/s], baked [1/s], RMSE [m], RMSE of the area [m^2]
    "circle": (5.73e1, 3.30e2, 8.47e-2, 5.63e-3),
    "square": (3.64, 3.32e2, 8.88e-2, 6.71e-3),
    "strip": (4.16, 3.24e2, 1.05e-1, 9.86e-3),
    "mixture": (5.70, 3.39e2, 9.06e-2, 7.20e-3),
}
SHARE, RMSE_M, PART, FASTER = 0.08, 0.03, 1.0 / 3.0, 2.0
"""Bars: share of the write limit in the same run; RMSE; part of the
nearest row's; and times the exact scanner's speed in the same run."""
COARSE = Density(distances=3, rotations=8)


def timed(
    spec: LidarSpec,
    table: LidarTable,
    drawn: list[Batch],
    repeats: int,
    control: str | None,
) -> dict[str, list[float]]:
    """Times of one batch [s], of several in a row: exact, baked, and only filling the output."""
    out = np.empty((len(drawn[0].lidar), spec.beams), np.float32)
    exact, baked = Scanner(spec, table, "exact"), Scanner(spec, table, "baked")
    full = [batch for batch in drawn if len(batch.lidar) == len(out)]
    bodies = [batch.bodies(exact) for batch in full]
    pairs = list(zip(full, bodies, strict=True))

    def scans(scanner: Scanner) -> None:
        for batch, placed in pairs:
            scanner.scan(batch.lidar, placed, out=out)

    def fills() -> None:
        for _ in pairs:
            out.fill(1.0)

    def slow() -> None:
        scans(exact)
        scans(exact)

    fast = slow if control == "slow" else lambda: scans(baked)
    calls = {"exact": lambda: scans(exact), "baked": fast, "write": fills}
    times = interleaved(calls, max(1, repeats // len(pairs)), warm=True)
    return {name: [each / len(pairs) for each in some] for name, some in times.items()}


def measure(
    spec: LidarSpec, name: str, scans: int, repeats: int, control: str | None
) -> tuple[dict[str, float], dict[str, Any]]:
    """Figures of one scene; and what belongs to its table and the write limit."""
    begin = time.perf_counter()
    table = bake(spec, SCENES[name], COARSE if control == "coarse" else DENSITY)
    bake_s = time.perf_counter() - begin
    drawn = batches(SCENES[name], scans, spec)
    exact = [scan(table, "exact", batch, spec) for batch in drawn]
    baked = [scan(table, "baked", batch, spec) for batch in drawn]
    if control == "nan":
        baked[0][0, 0] = np.nan
    rmse, area = errors(baked, exact, spec)
    plain = [
        scan(table, "exact", nearest_row(batch, table, spec), spec) for batch in drawn
    ]
    plain_rmse, plain_area = errors(plain, exact, spec)
    times = timed(spec, table, drawn, repeats, control)
    seconds = medians(times)
    batch = len(drawn[0].lidar)
    figures = {
        "exact_scans_per_s": batch / seconds["exact"],
        "baked_scans_per_s": batch / seconds["baked"],
        "rmse_m": rmse,
        "area_rmse_m2": area,
        "nearest_row_rmse_m": plain_rmse,
        "nearest_row_area_rmse_m2": plain_area,
    }
    writes = [batch / each for each in times["write"]]
    return figures, {"bytes": table.memory, "bake_s": bake_s, "writes": writes}


def judge(scene: dict[str, Any], write_limit: float) -> None:
    """Adds a scene's share of the write limit measured in turn with it, and the bars it meets."""
    scene["share_of_write_limit"] = scene["baked_scans_per_s"] / write_limit
    scene["bars_met"] = {
        "rate": scene["baked_scans_per_s"] >= FASTER * scene["exact_scans_per_s"],
        "share_of_write_limit": scene["share_of_write_limit"] >= SHARE,
        "rmse": scene["rmse_m"] <= RMSE_M,
        "rmse_of_nearest_row": scene["rmse_m"] <= PART * scene["nearest_row_rmse_m"],
        "area_of_nearest_row": scene["area_rmse_m2"]
        <= PART * scene["nearest_row_area_rmse_m2"],
    }


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    for name, scene in result["scenes"].items():
        ratio = scene["baked_scans_per_s"] / scene["exact_scans_per_s"]
        share = scene["share_of_write_limit"]
        told = {
            "rate": f"baked is {ratio:.2f} times as fast as exact, bar {FASTER:g}",
            "share_of_write_limit": f"baked is {share:.1%} of the write limit, bar {SHARE:.0%}",
            "rmse": f"RMSE {scene['rmse_m']:.4f} m, bar {RMSE_M:g}",
            "rmse_of_nearest_row": f"RMSE {scene['rmse_m']:.4f} m, bar a third of the nearest "
            f"row's {scene['nearest_row_rmse_m']:.4f}",
            "area_of_nearest_row": f"area RMSE {scene['area_rmse_m2']:.4f} m2, bar a third of the "
            f"nearest row's {scene['nearest_row_area_rmse_m2']:.4f}",
        }
        missed += [f"{name}: {told[bar]}" for bar in told if not scene["bars_met"][bar]]
    return missed


def run(
    spec: LidarSpec, scans: int, repeats: int, control: str | None
) -> dict[str, Any]:
    """All figures, see the head of this file."""
    bake(
        spec, SCENES["mixture"], Density(distances=3, rotations=1)
    )  # compiled before it is timed
    found = {name: measure(spec, name, scans, repeats, control) for name in SCENES}
    write_limit = float(
        np.median([rate for _, about in found.values() for rate in about["writes"]])
    )
    scenes: dict[str, dict[str, Any]] = {
        name: dict(figures) for name, (figures, _) in found.items()
    }
    for name, scene in scenes.items():
        judge(scene, float(np.median(found[name][1]["writes"])))
    return {
        "lidar": spec.name,
        "scenes": scenes,
        "write_limit_scans_per_s": write_limit,
        "table_bytes": {name: about["bytes"] for name, (_, about) in found.items()},
        "bake_s": {name: about["bake_s"] for name, (_, about) in found.items()},
        "scans_per_scene": scans,
    }


def table_of(result: dict[str, Any]) -> str:
    """The figures beside the paper's."""
    row = "{:<9}{:<13}{:>10}{:>10}{:>8}{:>11}{:>12}{:>9}{:>8}\n"
    text = row.format(
        "scene",
        "",
        "exact/s",
        "baked/s",
        "of write",
        "RMSE [m]",
        "area [m2]",
        "table",
        "bake",
    )
    for name, s in result["scenes"].items():
        text += row.format(
            name,
            "ours",
            f"{s['exact_scans_per_s']:.2e}",
            f"{s['baked_scans_per_s']:.2e}",
            f"{s['share_of_write_limit']:.0%}",
            f"{s['rmse_m']:.2e}",
            f"{s['area_rmse_m2']:.2e}",
            f"{result['table_bytes'][name] / 1e6:.1f} MB",
            f"{result['bake_s'][name]:.1f} s",
        )
        plain = (
            f"{s['nearest_row_rmse_m']:.2e}",
            f"{s['nearest_row_area_rmse_m2']:.2e}",
        )
        text += row.format("", "nearest row", "", "", "", *plain, "", "")
        if result["lidar"] == "paper":
            theirs = [f"{value:.2e}" for value in PAPER[name]]
            text += row.format("", "paper", *theirs[:2], "", *theirs[2:], "", "")
        missed = [bar for bar, met in s["bars_met"].items() if not met]
        text += f"{'':<9}bars {'all met' if not missed else 'missed: ' + ', '.join(missed)}\n"
    return text + (
        f"write limit: {result['write_limit_scans_per_s']:.2e} scans/s; errors over "
        f"{result['scans_per_scene']} scans of each scene\n"
    )


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--lidar", default="paper", help="a shipped one, or a file")
    parser.add_argument("--scans", type=int, default=4096, help="scans of each scene")
    parser.add_argument(
        "--repeats", type=int, default=200, help="timed batches of each scene"
    )
    given = parser.parse_args()
    result = run(load_lidar(given.lidar), given.scans, given.repeats, given.control)
    answer(result, missed_of(result), given.json, table_of(result))


if __name__ == "__main__":
    main()
