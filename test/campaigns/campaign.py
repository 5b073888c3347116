"""What a campaign is written with: the arguments that all have, and how it answers."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from registry import ROOT, bench, campaigns_of

answer = bench.answer
at_least = bench.at_least
at_most = bench.at_most
missed_bars = bench.missed_bars
__all__ = ["ROOT", "answer", "at_least", "at_most", "missed_bars", "parser_of"]


class Parser(argparse.ArgumentParser):
    """A parser that puts the short form in the place of `--short`."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.short: list[str] = []

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As usual; arguments after `--short` go before its own."""
        words = list(sys.argv[1:] if args is None else args)
        if "--short" in words:
            words.remove("--short")
            words = [*self.short, *words]
        return super().parse_known_args(words, namespace)


def parser_of(doc: str | None) -> Parser:
    """The parser of the running script, with its controls and its short form."""
    script = Path(sys.argv[0]).stem
    campaigns = campaigns_of(script)
    controls = {
        name: control.what
        for campaign in campaigns
        for name, control in campaign.controls.items()
    }
    parser = bench.parser_of(doc, controls, Parser)
    parser.short = campaigns[0].short.split()
    parser.add_argument(
        "--short", action="store_true", help=f"the short form: {campaigns[0].short}"
    )
    return parser
