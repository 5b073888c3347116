"""Damaged files: is any of them taken for a whole one?

Bags are cut off at any byte and changed at any place, as this package writes them and as others do.
Whatever can be read of them is read: by `nics bag info`, `nics generate` and `nics bag salvage`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from measuring.damaged_bags import damage_bags


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a damage was not found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--cuts", type=int, default=200, help="bags to cut off")
    parser.add_argument("--changes", type=int, default=500, help="bags to change")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        bags = damage_bags(Path(folder), given.cuts, given.changes, given.seed)
    result = {"tracebacks": bags.tracebacks, "silent_partial": bags.silent_partial}
    if given.json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        sys.stdout.write(
            f"bags: {given.cuts} cut off, {given.changes} changed: {bags.refused} refused, "
            f"{bags.accepted} read; {bags.tracebacks} tracebacks, "
            f"{bags.silent_partial} read in part\n"
        )
    sys.stderr.writelines(f"{line}\n" for line in bags.told)
    raise SystemExit(1 if any(result.values()) else 0)


if __name__ == "__main__":
    main()
