"""What an attacker hands in, as a file or a number: is it refused in a sentence, and soon?"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from parts import hostile_commands, hostile_configs, hostile_data, hostile_policies
from parts.abuse import Score
from parts.attempt import MOST_MEMORY, Attempt, Outcome, made

Source = Callable[[np.random.Generator, Path], Iterator[Attempt]]
SOURCES: tuple[Source, ...] = (
    hostile_policies.attempts,
    hostile_configs.attempts,
    hostile_data.attempts,
    hostile_commands.attempts,
)


@dataclass
class FileScore(Score):
    """A score that also knows what was tried, and that not everything is refused.

    Attributes:
        good: inputs tried that have nothing wrong with them.
        good_refused: those of them that were refused.
        by_kind: tries of each kind of input.
    """

    good: int = 0
    good_refused: int = 0
    by_kind: Counter[str] = field(default_factory=Counter)

    def judge(self, attempt: Attempt, outcome: Outcome) -> None:
        """Counts what came of an attempt."""
        self.tries += 1
        self.by_kind[attempt.kind] += 1
        self.good += attempt.verdict == "good"
        line = f"{attempt.kind}: {attempt.told}: {outcome.words}"
        if outcome.end == "traceback":
            self.count("tracebacks", line)
        elif outcome.end == "hang":
            self.count("hangs", f"{line} ({outcome.own_s:.1f} s)")
        elif outcome.end == "accepted" and attempt.verdict == "bad":
            self.count("accepted", line)
        elif outcome.end == "refused" and attempt.verdict == "good":
            self.count("good_refused", line)
        if outcome.memory > MOST_MEMORY:
            self.count("over_memory", f"{line} ({outcome.memory / 2**20:.0f} MB)")


def campaign(seed: int, rounds: int, control: str | None = None) -> FileScore:
    """Hands in `rounds` inputs of each source.

    Args:
        seed: of all that is drawn.
        rounds: tries of policies, of configurations, of data, and of commands.
        control: `credulous` takes the checks of policies and YAML out.
    """
    score = FileScore()
    with tempfile.TemporaryDirectory() as folder:
        if control == "credulous":
            _take_checks_out()
        for number, source in enumerate(SOURCES):
            place = Path(folder) / str(number)
            place.mkdir()
            ahead = source(np.random.default_rng([seed, number]), place)
            for _ in range(rounds):
                attempt = next(ahead)
                score.judge(attempt, made(attempt))
    return score


def _take_checks_out() -> None:
    """Policies and YAML are believed, in this process and those that it forks."""
    import yaml

    from nics_drl_bridge import config
    from nics_drl_bridge.policy.file import onnx_graph

    vars(config).update(_Loader=yaml.SafeLoader, MAX_BYTES=10**9)
    vars(onnx_graph).update(
        check_graph=_believe,
        check_seal=_believe,
        check_sizes=_believe,
        CONTRACT_LIMIT=10**9,
    )


def _believe(*_: object) -> None:
    """In the place of a check."""
