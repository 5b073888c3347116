"""Abuse with seeds: no error leaves a robot moving, and nothing that is handed in does harm.

`env` throws from every call of task, policy and user while a robot drives over DDS and in process.
`files` hands policies, configurations, recordings, bags, models, seeds and paths to the commands
and loaders that take them: what is bad has to be refused in one sentence, within 2 s of the
process's own time and 500 MB beyond what the libraries take; what is good has to be taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from importlib import import_module

from campaign import answer, parser_of
from parts.abuse import BARS, Score

from nics_drl_bridge.kernels import COMPILING

CAMPAIGNS = {"env": "parts.abuse_env", "files": "parts.abuse_files"}
OF_CONTROL = {"credulous": "files", "no_guard": "env"}


def run(name: str, seed: int, rounds: int, control: str | None) -> Score:
    """One campaign; a control belongs to one of them."""
    campaign: Callable[[int, int, str | None], Score] = import_module(
        CAMPAIGNS[name]
    ).campaign
    return campaign(
        seed, rounds, control if OF_CONTROL.get(control or "") == name else None
    )


def missed_of(scores: dict[str, Score]) -> list[str]:
    """A sentence for each bar that is missed, of each campaign."""
    missed = []
    for name, score in scores.items():
        if not score.tries > 0:
            missed.append(f"{name}: 0 tries, the bar is 1 or more")
        for bar in BARS:
            if getattr(score, bar) != 0:
                missed.append(
                    f"{name}: {bar} {getattr(score, bar)} of {score.tries}, the bar is 0"
                )
        if not getattr(score, "good", 1) > 0:
            missed.append(f"{name}: no good input was tried, the bar is 1 or more")
        if getattr(score, "good_refused", 0) != 0:
            missed.append(f"{name}: good_refused {score.good_refused}, the bar is 0")  # type: ignore[attr-defined]
    return missed


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when something got through."""
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--rounds", type=int, default=100, help="of each campaign's sources"
    )
    parser.add_argument(
        "--only", choices=list(CAMPAIGNS), help="one campaign; by default both"
    )
    given = parser.parse_args()
    COMPILING.quiet = True  # that kernels are compiled is no part of a sentence
    chosen = given.only or OF_CONTROL.get(given.control or "")
    names = [chosen] if chosen else list(CAMPAIGNS)
    scores = {
        name: run(name, given.seed, given.rounds, given.control) for name in names
    }
    kinds: Counter[str] = Counter()
    for name, score in scores.items():
        kinds.update(getattr(score, "by_kind", {name: score.tries}))
    keys = ("tries", *BARS)
    result = {
        key: sum(getattr(score, key) for score in scores.values()) for key in keys
    }
    result["good"] = sum(getattr(score, "good", 0) for score in scores.values())
    result["good_refused"] = sum(
        getattr(score, "good_refused", 0) for score in scores.values()
    )
    told = [line for score in scores.values() for line in score.told]
    answer(
        {**result, "by_kind": dict(kinds), "told": told}, missed_of(scores), given.json
    )


if __name__ == "__main__":
    main()
