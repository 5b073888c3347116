"""Damaged files: is any of them taken for a whole one, and does a kill leave one?

What the package writes is written by a process that is killed with SIGKILL at random moments, and
read back with one flipped bit. Bags are cut off at any byte and changed at any place, as this
package writes them and as others do; whatever can be read of them is read: by `nics bag info`,
`nics generate` and `nics bag salvage`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from measuring import artefacts
from measuring.damaged_bags import Score, damage_bags

BARS = ("torn", "accepted_corrupt", "tracebacks", "silent_partial")


def table_of(result: dict[str, Any], bags: Score) -> str:
    """One line per artefact, and one for the bags."""
    lines = [
        f"{name}: {one['torn']} torn by a kill, {one['accepted_corrupt']} read with a flipped bit"
        for name, one in result["artefacts"].items()
    ]
    lines.append(
        f"bags: {bags.refused} refused, {bags.accepted} read; {bags.tracebacks} tracebacks, "
        f"{bags.silent_partial} read in part"
    )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a damage was not found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--kills", type=int, default=300, help="of the writer of each artefact")
    parser.add_argument("--flips", type=int, default=300, help="of a bit of each artefact")
    parser.add_argument("--cuts", type=int, default=200, help="bags to cut off")
    parser.add_argument("--changes", type=int, default=500, help="bags to change")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    result = artefacts.measure(given.kills, given.flips, given.seed)
    with TemporaryDirectory() as folder:
        bags = damage_bags(Path(folder), given.cuts, given.changes, given.seed)
    result |= {"tracebacks": bags.tracebacks, "silent_partial": bags.silent_partial}
    if given.json:
        sys.stdout.write(json.dumps({key: result[key] for key in (*BARS, "artefacts")}) + "\n")
    else:
        sys.stdout.write(table_of(result, bags))
    sys.stderr.writelines(f"{line}\n" for line in bags.told)
    raise SystemExit(1 if any(result[key] for key in BARS) else 0)


if __name__ == "__main__":
    main()
