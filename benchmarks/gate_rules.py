"""Is every rule of the gate tested? Each is taken out in turn, and test/safety has to fail.

A rule is a row of one of the gate's tables: stops, refusals, checks before arming, what shapes a
motion, and what the shield takes for an obstacle. Each run is a process of its own.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from nics_drl_bridge.safety import arming, intake, rules, shield

ROOT = Path(__file__).resolve().parents[1]
TABLES = {
    "stop": (rules, "STOPS", lambda rule: rule.judge.__name__),
    "refusal": (intake, "REFUSALS", lambda rule: rule.name),
    "arming": (arming, "CHECKS", lambda check: check.__name__),
    "shaping": (rules, "SHAPERS", lambda shaper: shaper.__name__),
    "evidence": (shield, "EVIDENCE", lambda evidence: evidence.__name__),
}


def names() -> list[str]:
    """Every rule as `table/name`."""
    return [
        f"{kind}/{name_of(row)}"
        for kind, (module, table, name_of) in TABLES.items()
        for row in getattr(module, table)
    ]


def take_out(name: str) -> None:
    """Removes a rule from its table, in this process."""
    kind, _, rule = name.partition("/")
    module, table, name_of = TABLES[kind]
    rows = getattr(module, table)
    kept = tuple(row for row in rows if name_of(row) != rule)
    if len(kept) != len(rows) - 1:
        raise SystemExit(f"there is no rule {name!r}; known are {', '.join(names())}")
    setattr(module, table, kept)


def tests_fail_without(name: str | None) -> bool:
    """Whether some test fails without a rule; or, without a name, at all."""
    words = [sys.executable, __file__, "--inside", name or ""]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=600)
    if done.returncode not in (0, 1):
        raise SystemExit(f"pytest ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.returncode == 1


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a rule is not tested."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--inside", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.inside is not None:
        import pytest

        if given.inside:
            take_out(given.inside)
        raise SystemExit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "test/safety"]))
    if tests_fail_without(None):
        raise SystemExit("test/safety fails as it is; repair that first.")
    untested = []
    for name in names():
        fails = tests_fail_without(name)
        untested += [] if fails else [name]
        if not given.json:
            sys.stdout.write(f"{name:<34}{'found' if fails else 'NOT FOUND'}\n")
            sys.stdout.flush()
    if given.json:
        sys.stdout.write(json.dumps({"rules": len(names()), "untested": untested}) + "\n")
    raise SystemExit(1 if untested else 0)


if __name__ == "__main__":
    main()
