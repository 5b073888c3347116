"""How fast are other simulators at the same scan: 720 beams among ten circles and four walls?

ir-sim and irsim-x scan at the starts of the scenes of env_throughput.py, as the scanner does,
exact and baked, and every scan is compared with our exact one. What is timed is a scan alone, the
very call that their step makes, in turn with ours: `times_as_fast_at_equal_work`. What a scan
costs within their step is told beside it, and has to agree: see measuring/peers.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.peers import (
    MODEL,
    PEERS,
    WORLD,
    Measured,
    block_of,
    measure,
    missed_by,
    scenes,
)
from measuring.scenes import BATCH, CIRCLE, errors
from numpy.typing import NDArray

from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.sim.scenes import Scene

CONTROLS = {
    "shifted": "the same scan: the exact one, with which all are compared, is turned by one beam",
    "slow": "the speed: each scan that counts is ten",
    "other_way": "one way of measuring: a scan alone is asked of their lidar, not as by their step",
}
TIMES_SLOWER = 10
RENDERERS: tuple[Renderer, ...] = ("baked", "exact")
EQUAL_WORK_BARS = {"ir_sim": 2500.0, "irsim_x": 15.0}
"""How many times a peer's scans per second the baked ones are, at least."""
WRITE_BAR = 0.02
"""Of the rate at which ranges alone can be written."""
RMSE_BARS = {"baked": 0.01, "ir_sim": 0.03, "irsim_x": 0.01}
"""Against our exact scan [m]; the circles of ir-sim are polygons."""
HALF = 0.5 * MODEL.lidar.angle_increment
# Their beams are spread from the first to the last symmetrically; so are these, full circle or not.
SPEC = LidarSpec.model_validate(
    {
        **MODEL.lidar.model_dump(),
        "angle_min": MODEL.lidar.angle_min + HALF,
        "angle_max": MODEL.lidar.angle_max + HALF,
    }
)


class Scans:
    """A batch of scans, each in a scene of its own."""

    def __init__(self, table: LidarTable, drawn: list[Scene], often: int) -> None:
        self.table = table
        self.often = often
        self.starts = np.array([scene.starts[0] for scene in drawn])
        poses = np.zeros((len(drawn), drawn[0].bodies.shape[0], 3))
        poses[..., :2] = [scene.bodies[:, :2] for scene in drawn]
        placed = Scanner(SPEC, table).place((CIRCLE,) * poses.shape[1], poses)
        self.scene = (placed, WORLD.all_walls())
        self.out = np.empty((len(drawn), SPEC.beams), np.float32)

    def call(self, renderer: Renderer) -> Callable[[], None]:
        """Renders the batch."""
        scanner = Scanner(SPEC, self.table, renderer)

        def scans() -> None:
            for _ in range(self.often):
                scanner.scan(self.starts, *self.scene, out=self.out)

        return scans

    def write(self) -> None:
        """Writes as much, and no more."""
        self.out.fill(1.0)

    def ranges(self, renderer: Renderer, turned: float = 0.0) -> NDArray[np.float32]:
        """(N, B) of the batch, with every lidar turned [m, rad]."""
        scanner = Scanner(SPEC, self.table, renderer)
        return scanner.scan(self.starts + np.array([0.0, 0.0, turned]), *self.scene)


def run(
    scans: int, count: int, repeats: int, peers: tuple[str, ...], control: str | None
) -> tuple[dict[str, Any], Measured]:
    """All rates; `None` for a peer that can't be installed or was not asked for."""
    table = bake(SPEC, (CIRCLE,))
    batch = Scans(table, scenes(scans), TIMES_SLOWER if control == "slow" else 1)
    calls: dict[str, Callable[[], object]] = {
        name: batch.call(name) for name in RENDERERS
    }
    drawn = scenes(count)
    alone = "scan_by_the_lidar" if control == "other_way" else "scan"
    found = measure({**calls, "write": batch.write}, peers, drawn, repeats, alone)
    rate = {name: scans / seconds for name, seconds in found.seconds.items()}
    theirs = {name: 1.0 / one["scan_s"] for name, one in found.peers.items()}
    few = Scans(table, drawn, 1)
    exact = few.ranges("exact", SPEC.angle_increment if control == "shifted" else 0.0)
    ranges = {"baked": few.ranges("baked"), **found.ranges}
    result = {
        "times_as_fast_at_equal_work": {
            name: rate["baked"] / one for name, one in theirs.items()
        },
        "baked": rate["baked"],
        "exact": rate["exact"],
        **dict.fromkeys(PEERS),
        **theirs,
        "rmse_m": {name: errors([each], [exact])[0] for name, each in ranges.items()},
        **block_of(found),
        "share_of_write_limit": rate["baked"] / rate["write"],
        "write_limit_scans_per_s": rate["write"],
    }
    return result, found


def judge(result: dict[str, Any], found: Measured) -> list[str]:
    """The bars that were missed."""
    missed = []
    if not result["share_of_write_limit"] >= WRITE_BAR:
        missed.append(
            f"share_of_write_limit: {result['share_of_write_limit']:.4f}, bar {WRITE_BAR}"
        )
    for name, ratio in result["times_as_fast_at_equal_work"].items():
        if not ratio >= EQUAL_WORK_BARS[name]:
            missed.append(
                f"times_as_fast_at_equal_work: {ratio:.0f} times {name}, "
                f"bar {EQUAL_WORK_BARS[name]:.0f}"
            )
    for name, rmse in result["rmse_m"].items():
        if not rmse <= RMSE_BARS[name]:
            missed.append(f"rmse_m of {name}: {rmse:.4f} m, bar {RMSE_BARS[name]} m")
    return missed + missed_by(found)


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a bar is missed."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--scans", type=int, default=BATCH, help="scans of one of our batches"
    )
    parser.add_argument(
        "--scenes", type=int, default=50, help="scenes that the peers go through"
    )
    parser.add_argument("--repeats", type=int, default=10, help="timed rounds of each")
    parser.add_argument("--without-peers", action="store_true", help="install nothing")
    given = parser.parse_args()
    peers = () if given.without_peers else tuple(PEERS)
    result, found = run(given.scans, given.scenes, given.repeats, peers, given.control)
    answer(result, judge(result, found), given.json)


if __name__ == "__main__":
    main()
