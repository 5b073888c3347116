"""Damaged files: is any of them taken for a whole one, and does a kill leave one?

What the package writes is written by a process that is killed with SIGKILL at random moments, and
read back with one flipped bit. Bags are cut off at any byte and changed at any place, as this
package writes them and as others do; whatever can be read of them is read: by `nics bag info`
and `nics generate`.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from campaign import answer, at_least, at_most, missed_bars, parser_of
from parts import artefacts
from parts.damaged_bags import damage_bags

BARS = {
    **dict.fromkeys(
        ("torn", "accepted_corrupt", "tracebacks", "silent_partial"), at_most(0)
    ),
    **dict.fromkeys(("kills", "flips", "cuts", "changes"), at_least(1)),
}
LEAST_DURING = 0.25
"""Share of the kills that have to hit a write."""


def missed_of(result: dict[str, Any]) -> list[str]:
    """A sentence for each bar that is missed."""
    during = at_least(max(1, LEAST_DURING * result["kills"]))
    return missed_bars(result, BARS | {"kills_during_a_write": during})


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a damage was not found."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--kills", type=int, default=300, help="of the writer of each artefact"
    )
    parser.add_argument(
        "--flips", type=int, default=300, help="of a bit of each artefact"
    )
    parser.add_argument("--cuts", type=int, default=200, help="bags to cut off")
    parser.add_argument("--changes", type=int, default=500, help="bags to change")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    result = artefacts.measure(given.kills, given.flips, given.seed, given.control)
    with TemporaryDirectory() as folder:
        bags = damage_bags(Path(folder), given.cuts, given.changes, given.seed)
    result |= {"tracebacks": bags.tracebacks, "silent_partial": bags.silent_partial}
    result |= {"cuts": given.cuts, "changes": given.changes, "told": bags.told}
    answer(result, missed_of(result), given.json)


if __name__ == "__main__":
    main()
