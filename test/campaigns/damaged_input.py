"""Does damaged or hostile input do harm? Every loader gets files that Hypothesis has damaged.

Recordings, models, lidar tables, black boxes, policies, checkpoints, bags of this package and of
others, CSV and YAML are cut, changed in some bytes or in a value, replaced by what is no file, or
by what would take memory, time or run code. What is bad has to be refused in one sentence, within
2 s of the process's own time and 500 MB beyond what the libraries take; where damage is not found,
what is read has to be what was written; and what is whole has to be taken.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any
from unittest import mock

from campaign import Given, Result, at_least, at_most, run_campaign
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import given as drawn
from hypothesis import strategies as st
from parts.attempt import MOST_MEMORY, Attempt, Outcome, make
from parts.damage import attempts
from parts.loaders import LOADERS

from nics_drl_bridge.kernels import COMPILING

WRONG = ("accepted", "tracebacks", "hangs", "over_memory", "good_refused")
BARS = {
    **dict.fromkeys(WRONG, at_most(0)),
    "tries": at_least(1),
    "good": at_least(1, "no good input was tried"),
}
CHECKSUMS = (
    "files.check_sealed",
    "files.check_sums",
    "lidar.table.check_sums",
    "policy.file.onnx_graph.check_seal",
    "policy.train.checkpoint.check_sealed",
)
CHECKS = tuple(
    f"policy.file.onnx_graph.check_{name}" for name in ("graph", "seal", "sizes")
)


@contextlib.contextmanager
def take_out(control: str | None) -> Any:
    """Takes out what a control takes out, here and in all forked processes."""
    with contextlib.ExitStack() as stack:
        for place in {"no_checksum": CHECKSUMS, "credulous": CHECKS}.get(
            control or "", ()
        ):
            patch = mock.patch(f"nics_drl_bridge.{place}", return_value=True)
            stack.enter_context(patch)
        if control == "credulous":
            import yaml

            from nics_drl_bridge import config

            patch = mock.patch.multiple(
                config, _Loader=yaml.SafeLoader, MAX_BYTES=10**9
            )
            stack.enter_context(patch)
        yield


def judge(attempt: Attempt, outcome: Outcome) -> list[str]:
    """Returns which bars an attempt misses."""
    missed = []
    if outcome.end in ("traceback", "hang"):
        missed.append(f"{outcome.end}s")
    elif outcome.end == "changed" or (outcome.end, attempt.verdict) == (
        "accepted",
        "bad",
    ):
        missed.append("accepted")
    elif (outcome.end, attempt.verdict) == ("refused", "good"):
        missed.append("good_refused")
    if outcome.memory > MOST_MEMORY:
        missed.append("over_memory")
    return missed


def measure(given: Given) -> Result:
    """Hands in so many inputs and counts what came of them."""
    COMPILING.quiet = True  # that kernels are compiled is no part of a sentence
    counts = Counter(dict.fromkeys(("tries", "good", *WRONG), 0))
    kinds: Counter[str] = Counter()
    told = []
    with tempfile.TemporaryDirectory() as name:
        wholes = {}
        for loader in LOADERS:
            home = Path(name) / f"whole_{loader.name}"
            home.mkdir()
            loader.write(home / loader.name, 0)
            wholes[loader.name] = home / loader.name, loader.read(home / loader.name)

        @seed(given.seed)
        @settings(
            max_examples=given.rounds,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @drawn(st.data())
        def hand_in(data: st.DataObject) -> None:
            attempt = data.draw(attempts(wholes, Path(name) / "damaged"))
            outcome = make(attempt)
            counts.update(tries=1, good=int(attempt.verdict == "good"))
            kinds[attempt.kind] += 1
            for bar in judge(attempt, outcome):
                counts[bar] += 1
                line = f"{bar}: {attempt.kind}: {attempt.told}: {outcome.words}"
                told.append(f"{line} ({outcome.own_s:.1f} s)")

        with take_out(given.control):
            hand_in()
    return {**counts, "by_kind": dict(kinds), "told": told}


if __name__ == "__main__":
    run_campaign(measure, BARS, {"seed": 0, "rounds": (2000, "inputs to hand in")})
