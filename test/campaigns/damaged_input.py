"""Does damaged or hostile input do harm? Every loader gets files that Hypothesis has damaged.

Recordings, models, lidar tables, black boxes, policies, checkpoints, bags of this package and of
others, CSV and YAML are cut, changed in some bytes or in a value, or replaced by what is no file.
What is bad has to be refused in one sentence, within 2 s of the process's own time and 500 MB
beyond what the libraries take; where damage is not found, what is read has to be what was written;
and what is whole has to be taken.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from pathlib import Path
from unittest import mock

import yaml
from campaign import Given, Result, at_least, at_most, run_campaign
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import given as drawn
from hypothesis import strategies as st
from parts.attempt import MOST_MEMORY, Attempt, Outcome, make_attempt
from parts.damage import draw_attempts
from parts.loaders import LOADERS

from nics_drl_bridge import config
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


def take_out(control: str | None, stack: contextlib.ExitStack) -> None:
    """Takes out what a control takes out, here and in all forked processes."""
    taken = {"no_checksum": CHECKSUMS, "credulous": CHECKS}
    for place in taken.get(control or "", ()):
        stack.enter_context(mock.patch(f"nics_drl_bridge.{place}", return_value=True))
    if control == "credulous":
        changes = {"_Loader": yaml.SafeLoader, "MAX_BYTES": 10**9}
        stack.enter_context(mock.patch.multiple(config, **changes))


def judge(attempt: Attempt, outcome: Outcome) -> list[str]:
    """Returns which bars an attempt misses."""
    wrong = {
        "tracebacks": outcome.end == "traceback",
        "hangs": outcome.end == "hang",
        "accepted": outcome.end == "changed"
        or (outcome.end == "accepted" and attempt.verdict == "bad"),
        "good_refused": outcome.end == "refused" and attempt.verdict == "good",
        "over_memory": outcome.memory > MOST_MEMORY,
    }
    return [bar for bar, is_missed in wrong.items() if is_missed]


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
            attempt = data.draw(draw_attempts(wholes, Path(name) / "damaged"))
            outcome = make_attempt(attempt)
            counts.update(tries=1, good=int(attempt.verdict == "good"))
            kinds[attempt.kind] += 1
            for bar in judge(attempt, outcome):
                counts[bar] += 1
                line = f"{bar}: {attempt.kind}: {attempt.told}: {outcome.words}"
                told.append(f"{line} ({outcome.own_s:.1f} s)")

        with contextlib.ExitStack() as stack:
            take_out(given.control, stack)
            hand_in()
    return {**counts, "by_kind": dict(kinds), "told": told}


if __name__ == "__main__":
    run_campaign(measure, BARS, {"seed": 0, "rounds": (2000, "inputs to hand in")})
