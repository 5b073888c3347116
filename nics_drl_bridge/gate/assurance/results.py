"""Results of the episodes and faults of a run: rates with bounds, and clusters of failures."""

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from nics_drl_bridge.confidence import bound_rate
from nics_drl_bridge.gate.assurance.protocol import (
    CLAIMS,
    KINDS,
    LIMITS,
    STOPS,
    TOUCHES,
)
from nics_drl_bridge.gate.assurance.run import Row

CELL_M = 2.0  # side of the squares of a world by which failures are clustered
FAILED: dict[str, Callable[[Row], bool]] = {
    STOPS: lambda row: not row.get("in_time", True),
    LIMITS: lambda row: bool(row.get("violations")),
    TOUCHES: lambda row: bool(row.get("contact")),
}


def summarise(rows: Sequence[Row], faults: int) -> dict[str, Any]:
    """Returns the results of a run's rows as plain data; `faults` of them should be faults."""
    tried = [row for row in rows if row["gated"]]
    controls = [row for row in rows if not row["gated"]]
    episodes = [row for row in tried if "fault" not in row]
    return {
        "claims": _judge(tried),
        "control": _judge(controls),
        "drivers": _count_touches(tried, controls),
        "episodes": len(episodes),
        "path_m": math.fsum(row["path"] for row in episodes),
        "seconds": math.fsum(row["seconds"] for row in episodes),
        "not_injected": faults - sum("fault" in row for row in rows),
        "walked_into": sum(row["walked_into"] for row in episodes),
        "latched": dict(Counter(row["latched"] for row in episodes if row["latched"])),
        "clusters": find_clusters(tried or controls),
        "failures": [row for row in tried or controls if _list_failed(row)],
    }


def _count_touches(
    tried: Sequence[Row], controls: Sequence[Row]
) -> dict[str, list[int]]:
    """Returns, by driver, contacts and episodes with the gate, then both without it."""
    counts: dict[str, list[int]] = {}
    for kind in KINDS:
        counts[kind] = []
        for rows in (tried, controls):
            of_kind = [row["contact"] for row in rows if row["kind"] == kind]
            counts[kind] += [sum(of_kind), len(of_kind)]
    return counts


def _judge(rows: Sequence[Row]) -> dict[str, Any]:
    figures = {}
    for claim in CLAIMS:
        tested = [row for row in rows if ("fault" in row) == (claim == STOPS)]
        failures = sum(map(FAILED[claim], tested))
        low, high = bound_rate(failures, len(tested))
        figures[claim] = {
            "trials": len(tested),
            "failures": failures,
            "rate_low": low,
            "rate_high": high,
            "one_sided": failures == 0,
        }
    return figures


def _list_failed(row: Row) -> list[str]:
    return [claim for claim in CLAIMS if FAILED[claim](row)]


def find_clusters(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Returns the failures by claim, driver or fault, and place, the largest cluster first."""
    failed: list[tuple[tuple[Any, ...], int]] = []
    for row in rows:
        near = [CELL_M * round(value / CELL_M) for value in row.get("position", ())]
        place = (row["kind"], row.get("world", ""), tuple(near))
        failed += [((claim, *place), row["seed"]) for claim in _list_failed(row)]
    return [
        {
            "claim": claim,
            "kind": kind,
            "world": world,
            "near": near,
            "failures": len(seeds),
            "seeds": seeds,
        }
        for (claim, kind, world, near), seeds in cluster_seeds(failed)
    ]


def cluster_seeds(
    failed: Iterable[tuple[tuple[Any, ...], int]],
) -> list[tuple[tuple[Any, ...], list[int]]]:
    """Collects the seeds of failures by their cluster; returns the largest cluster first."""
    seeds = defaultdict[tuple[Any, ...], list[int]](list)
    for cluster, seed in failed:
        seeds[cluster].append(seed)
    return sorted(seeds.items(), key=lambda item: (-len(item[1]), item[0]))
