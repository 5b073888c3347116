"""How fast are other simulators at the same scan: 720 beams among ten circles?

ir-sim and irsim-x both install the module `irsim`, so each gets an environment of its own, made
at first use from the package registry and kept in the user's cache folder. What is timed
is their lidar alone, not their whole step. Every scan is compared with our exact one, so that
all do the same.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measuring.environments import NotInstalledError, python_with, run
from measuring.rates import interleaved, medians
from measuring.scenes import BATCH, CIRCLE, SPEC, Batch, errors, random_batch, scan

from nics_drl_bridge.lidar.baking import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import LidarTable

WITH = ("numpy==2.4.6", "shapely==2.2.0", "matplotlib==3.11.2")
PEERS = {"ir_sim": ("ir-sim==2.12.0", *WITH), "irsim_x": ("irsim-x==1.1.4", *WITH)}
SCRIPT = Path(__file__).resolve().parent / "measuring" / "irsim_scans.py"
HALF = 0.5 * SPEC.angle_increment
# Their beams are spread from the first to the last symmetrically; so are these, full circle or not.
SHIFTED = LidarSpec.model_validate(
    {**SPEC.model_dump(), "angle_min": SPEC.angle_min + HALF, "angle_max": SPEC.angle_max + HALF}
)


def ours(table: LidarTable, batch: Batch, repeats: int) -> dict[str, float]:
    """Scans per second, exact and baked, in batches on one thread."""
    out = np.empty((len(batch.lidar), SHIFTED.beams), np.float32)
    calls = {}
    for name in ("baked", "exact"):
        scanner = Scanner(SHIFTED, table, name)
        placed = batch.bodies(scanner)
        calls[name] = lambda s=scanner, b=placed: s.scan(batch.lidar, b, out=out)
    seconds = medians(interleaved(calls, repeats))
    return {name: len(batch.lidar) / each for name, each in seconds.items()}


def theirs(name: str, batch: Batch, repeats: int) -> tuple[float, Any]:
    """Scans per second of a peer, and its ranges (N, B)."""
    about = {
        "beams": SHIFTED.beams,
        "angle_range": float(SHIFTED.angles[-1] - SHIFTED.angles[0]),
        "range_min": SHIFTED.range_min,
        "range_max": SHIFTED.range_max,
        "radius": CIRCLE.radius,
    }
    task = {"about": about, "scenes": batch.poses[..., :2].tolist(), "repeats": repeats}
    python = python_with(name, PEERS[name])
    with tempfile.TemporaryDirectory() as folder:
        asked, answered = Path(folder) / "task.json", Path(folder) / "ranges.json"
        asked.write_text(json.dumps(task))
        printed = run(python, SCRIPT, str(asked), str(answered))
        ranges = np.array(json.loads(answered.read_text()), dtype=np.float32)
    return json.loads(printed.strip().splitlines()[-1])["scans_per_s"], ranges


def run_all(scans: int, scenes: int, repeats: int, peers: tuple[str, ...]) -> dict[str, Any]:
    """All rates; `None` for a peer that can't be installed, and why."""
    table = bake(SHIFTED, (CIRCLE,))
    result: dict[str, Any] = ours(table, random_batch((CIRCLE,), scans, 0), repeats)
    few = random_batch((CIRCLE,), scenes, 0)
    exact = scan(table, "exact", few, SHIFTED)
    result.update(ir_sim=None, irsim_x=None, rmse_m={}, missing={})
    for name in peers:
        try:
            result[name], ranges = theirs(name, few, repeats)
        except NotInstalledError as error:
            result["missing"][name] = str(error)
            continue
        result["rmse_m"][name] = errors([ranges], [exact])[0]
    return result


def table_of(result: dict[str, Any]) -> str:
    """The rates for people."""
    row = "{:<9}{:>12}{:>18}{:>24}\n"
    text = row.format("", "scans/s", "baked is faster", "RMSE against ours [m]")
    for name in ("baked", "exact", "ir_sim", "irsim_x"):
        if result[name] is None:
            text += f"{name:<9}{result['missing'].get(name, 'not asked for')}\n"
            continue
        rmse = result["rmse_m"].get(name)
        text += row.format(
            name,
            f"{result[name]:.3g}",
            f"{result['baked'] / result[name]:.3g} x",
            "" if rmse is None else f"{rmse:.1e}",
        )
    return text


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--scans", type=int, default=BATCH, help="scans of one of our batches")
    parser.add_argument("--scenes", type=int, default=10, help="scenes that the peers scan")
    parser.add_argument("--repeats", type=int, default=100, help="timed scans of each scene")
    parser.add_argument("--without-peers", action="store_true", help="install nothing")
    given = parser.parse_args()
    peers = () if given.without_peers else tuple(PEERS)
    result = run_all(given.scans, given.scenes, given.repeats, peers)
    sys.stdout.write(json.dumps(result) + "\n" if given.json else table_of(result))
    for reason in result["missing"].values():
        sys.stderr.write(f"{reason}\n")


if __name__ == "__main__":
    main()
