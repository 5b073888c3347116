"""How every benchmark is asked and how it answers: one parser, one JSON object, one exit code.

A benchmark is to be able to fail. It says in sentences which of its bars were missed, and ends
with 1 if any was. Its controls take out what it measures (no filter, a robot that stands, a naive
writer): run with one, it has to miss a bar, which its tests look at.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

FAILURES = "failures"


def parser_of(doc: str | None, controls: Mapping[str, str]) -> argparse.ArgumentParser:
    """A parser with `--json` and `--control`, described by the first line of a module.

    Args:
        doc: of the benchmark's module.
        controls: name -> what is taken out; `--control` alone takes the first one.
    """
    parser = argparse.ArgumentParser(
        description=(doc or "").splitlines()[0],
        epilog="controls, which must fail: "
        + "; ".join(f"{k}: {v}" for k, v in controls.items()),
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--control",
        nargs="?",
        const=next(iter(controls)),
        choices=list(controls),
        help="take out what is measured: the benchmark then has to fail",
    )
    return parser


def answer(
    result: Mapping[str, Any], missed: Sequence[str], table: str, as_json: bool
) -> NoReturn:
    """Prints a result and the bars that were missed, and ends with 1 if there are any, else 0.

    Args:
        result: what was measured, as JSON can hold it; what is not finite becomes null.
        missed: a sentence for each bar that was missed, with the figure and the bar.
        table: the result for people, which ends with a line feed.
        as_json: whether to print one JSON object instead, with the sentences as `failures`.
    """
    if as_json:
        told = finite({**result, FAILURES: list(missed)})
        sys.stdout.write(json.dumps(told, allow_nan=False) + "\n")
    else:
        sys.stdout.write(table + "".join(f"FAILED: {line}\n" for line in missed))
    raise SystemExit(1 if missed else 0)


def finite(value: Any) -> Any:
    """The same with None for each number that JSON does not know: NaN and the infinities."""
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
