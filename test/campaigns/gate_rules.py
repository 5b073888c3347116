"""Is every rule of the gate tested? Each is taken out in turn, and test/gate has to fail.

A rule is a row of one of the gate's tables: stops, refusals, checks before arming, what shapes a
motion, and what the shield takes for an obstacle. Each run is a process of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from typing import NoReturn

from campaign import ROOT, Bars, Given, Result, Silence, at_least, run_campaign

from nics_drl_bridge.gate import arming, evidence, gate, intake, stops

LEAST_RULES = 30  # a run that finds fewer has lost a table
TESTS = "test/gate"
UNTESTED = "covers_nothing"  # a rule that stops nothing: nobody can miss it
OTHER_TEST = "test/gate/test_stopping.py"
TABLES = {
    "stop": (stops, "STOPS", lambda rule: rule.name),
    "refusal": (intake, "REFUSALS", lambda rule: rule[1].__name__),
    "arming": (arming, "CHECKS", str),
    "shaping": (gate, "SHAPERS", lambda shaper: shaper.__name__),
    "evidence": (evidence, "EVIDENCE", lambda place: place.__name__),
}


def list_rules() -> list[str]:
    """Returns every rule as `table/name`."""
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
    kept = [row for row in rows if name_of(row) != rule]
    if len(kept) != len(rows) - 1:
        known = ", ".join(list_rules())
        raise SystemExit(f"there is no rule {name!r}; known are {known}")
    is_named = isinstance(rows, dict)
    setattr(module, table, {key: rows[key] for key in kept} if is_named else kept)


def add_untested() -> None:
    """Puts a rule that no test covers into the table of stops, in this process."""
    nothing = stops.Rule(UNTESTED, "", lambda config, state, now: stops.NO_FAULT)
    stops.STOPS = (*stops.STOPS, nothing)


def run_inside(name: str, tests: str) -> NoReturn:
    """Runs the tests without a rule, or with all, in this process; ends with pytest's code."""
    import pytest

    if name:
        take_out(name)
    raise SystemExit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", tests]))


def tests_fail_without(name: str, given: Given) -> bool:
    """Returns whether some test fails without a rule; or, without a name, at all."""
    tests = OTHER_TEST if given.control == "no_tests" and name else given.tests
    words = [sys.executable, __file__, "--tests", tests, "--inside", name]
    words += ["--control", given.control] if given.control else []
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=600)
    if done.returncode not in (0, 1):
        said = done.stdout + done.stderr
        raise SystemExit(f"pytest ended with {done.returncode}:\n{said}")
    return done.returncode == 1


def measure(given: Given) -> Result:
    """Takes out one rule after the other."""
    is_untested = given.control == "untested_rule"
    if is_untested:
        add_untested()
    if given.inside is not None:
        run_inside(given.inside, given.tests)
    if tests_fail_without("", given):
        raise SystemExit(f"{given.tests} fails as it is; repair that first.")
    known = list_rules()
    asked = given.rule or known
    if is_untested:
        asked = [f"stop/{UNTESTED}"]
    untested = {
        f"rule {name}": "no test misses it"
        for name in asked
        if not tests_fail_without(name, given)
    }
    return {"rules": len(known), "looked_at": len(asked), "untested": untested}


def set_bars(result: Result) -> Bars:
    return {
        "rules": at_least(LEAST_RULES),
        "looked_at": at_least(1),
        "untested": dict.fromkeys(result["untested"], Silence()),
    }


OPTIONS = {
    "rule": {"action": "append", "help": "only this one; else all"},
    "tests": (TESTS, "that have to fail"),
    "inside": {"help": argparse.SUPPRESS},
}

if __name__ == "__main__":
    run_campaign(measure, set_bars, OPTIONS)
