"""Fills in the tables of figures of README.md and docs/: `make tables`.

`tables.md` holds them before that. What stands between `<!-- results:NAME -->` and
`<!-- /results -->` of a document is the table `NAME`, filled in from `results.json`.
"""

import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import harmonic_mean, mean
from textwrap import shorten
from typing import Any

from bench import MET, RESULTS, ROOT, read_results, read_sections

PLACEHOLDER = re.compile(
    r"\{(?:(?P<how>max|min|sum|mean|harmonic_mean) )?(?P<path>[^{}: ]+)(?: of (?P<run>\w+))?"
    r"(?: x(?P<factor>[0-9.e+-]+))?(?::(?P<format>[^{}]*))?\}"
)
"""A figure in a cell: a path into the result of a run, by default that of the row."""
REGION = re.compile(r"<!-- results:([a-z0-9_]+) -->\n(.*?)<!-- /results -->", re.DOTALL)
HOW = {"max": max, "min": min, "sum": sum, "mean": mean, "harmonic_mean": harmonic_mean}
NOT_MEASURED = "not measured"
OF_MISSED = "†"
ELSEWHERE = "§"
VERSIONS = ("numba", "numpy")
MOST_TOLD = 3  # bars that a run missed; of more, one fewer and how many more there are
MACHINE = "machine"
"""The name of the region that says on what was measured."""


@dataclass(frozen=True)
class Table:
    """A table of figures, before they are filled in.

    Attributes:
        head: its columns.
        rows: the run that a row is of, and its cells, with placeholders.
        notes: whether the marks are explained below the table.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: bool = True


@cache
def read_tables() -> Mapping[str, Table]:
    """The tables of `tables.md`, by name."""
    tables = {}
    for title, (head, *rows) in read_sections().items():
        name, _, without_notes = title.partition(", ")
        tables[name] = Table(
            tuple(head[1:]), tuple(map(tuple, rows)), not without_notes
        )
    del tables["runs"]
    return tables


@cache
def paths_of(run: str) -> tuple[tuple[str, ...], ...]:
    """The paths to all figures of a run that some table shows."""
    return tuple(
        tuple(match["path"].split("."))
        for table in read_tables().values()
        for row in table.rows
        for cell in row[1:]
        for match in PLACEHOLDER.finditer(cell)
        if (match["run"] or row[0]) == run
    )


def look_up(value: Any, keys: Sequence[str]) -> list[Any]:
    """All that a path leads to; nothing when it leads nowhere."""
    if not keys:
        return [value]
    if not isinstance(value, Mapping):
        return []
    parts = value.values() if keys[0] == "*" else [value.get(keys[0])]
    return [each for part in parts for each in look_up(part, keys[1:])]


def write_value(value: Any, how: str) -> str:
    """A value by a Python format, its exponent and per cent sign as in our texts."""
    text = format(value, how)
    if isinstance(value, str | bool):
        return text
    text = re.sub(r"e\+?(-?)0*(\d+)$", r"e\1\2", text)
    return text.replace("%", " %")


def line_of(cells: Sequence[str]) -> str:
    """A line of a table."""
    return "|".join(["", *(f" {cell} " if cell else " " for cell in cells), ""])


def machine_of(entry: Mapping[str, Any]) -> str:
    """On what a run was made, in words."""
    machine = entry["machine"]
    return f"{machine['cores']} shared cores ({machine['cpu']})"


class Page:
    """The tables of one set of results."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.runs = results
        machines = Counter(map(machine_of, self.runs.values()))
        self.machines = [machine for machine, _ in machines.most_common()]
        """In words, that of most runs first."""

    def figure(self, match: re.Match[str], run: str) -> str:
        """One placeholder. Raises LookupError for a figure that was not measured."""
        result = self.runs.get(match["run"] or run, {}).get("result")
        values = look_up(result, match["path"].split("."))
        if not values or not all(
            isinstance(each, str | float | int) for each in values
        ):
            raise LookupError(match["path"])
        value = HOW[match["how"]](values) if match["how"] else values[0]
        if match["factor"]:
            value = float(value) * float(match["factor"])
        return write_value(value, match["format"] or "")

    def cell(self, template: str, run: str) -> tuple[str, set[str]]:
        """The text of a cell, and the runs that it is from."""
        runs = {match["run"] or run for match in PLACEHOLDER.finditer(template)}
        try:
            text = PLACEHOLDER.sub(lambda match: self.figure(match, run), template)
        except (LookupError, ValueError):
            return NOT_MEASURED, runs
        return "".join([text, *self.marks(runs)]), runs

    def elsewhere(self, run: str) -> bool:
        """Whether a run was made on another machine than most."""
        return machine_of(self.runs[run]) != self.machines[0]

    def marks(self, runs: set[str]) -> list[str]:
        """Signs for a cell whose runs missed a bar, or were made on another machine."""
        known = [name for name in runs if name in self.runs]
        signs = {
            OF_MISSED: any(self.runs[name]["state"] != MET for name in known),
            ELSEWHERE: any(map(self.elsewhere, known)),
        }
        return [sign for sign, holds in signs.items() if holds]

    def table(self, table: Table) -> str:
        """A table, and below it what is not as it should be with its runs."""
        lines = [line_of(table.head), f"|{'---|' * len(table.head)}"]
        used: set[str] = set()
        for run, *cells in table.rows:
            told = [self.cell(each, run) for each in cells]
            lines.append(line_of([text for text, _ in told]))
            used |= {name for _, runs in told for name in runs}
        if table.notes:
            lines += self.notes(used)
        return "\n".join(lines) + "\n"

    def notes(self, runs: set[str]) -> list[str]:
        """A sentence for each run that missed a bar or broke."""
        notes = []
        for name in sorted(runs & set(self.runs)):
            entry = self.runs[name]
            if entry["state"] != MET:
                told = entry["failures"] or [entry["error"] or ""]
                shown = told if len(told) <= MOST_TOLD else told[: MOST_TOLD - 1]
                wrong = "; ".join(shown)
                wrong = shorten(wrong, 300, placeholder=" ...")  # between words
                if more := len(told) - len(shown):
                    wrong += f"; and {more} more"
                notes.append(
                    f"{OF_MISSED} `{entry['script']}` {entry['state']}: {wrong}"
                )
        away = sorted({name for name in runs & set(self.runs) if self.elsewhere(name)})
        if away:
            notes.append(f"{ELSEWHERE} on {', '.join(self.machines[1:])}")
        return [line for note in notes for line in ("", note)]

    def about(self) -> str:
        """On what was measured."""
        if not self.runs:
            return "Nothing is measured yet.\n"
        entries = list(self.runs.values())
        usual = (e["machine"] for e in entries if machine_of(e) == self.machines[0])
        machine = next(usual)
        others = "".join(
            f", or on {one} where marked {ELSEWHERE}" for one in self.machines[1:]
        )
        commits = {e["commit"] for e in entries}
        changed = " and changes" if any(e["dirty"] for e in entries) else ""
        several = f"{len(commits)} commits"
        told = several if len(commits) > 1 else f"commit {entries[0]['commit']}"
        days = sorted(e["started"][:10] for e in entries)
        loads = [e["load"] for e in entries]
        versions = [f"Python {machine['python']}"]
        libraries = machine.get("libraries", {})
        versions += [
            f"{name} {libraries[name]}" for name in VERSIONS if name in libraries
        ]
        return (
            f"On {self.machines[0]} with {machine['memory_gb']:.0f} GB{others}, "
            f"{', '.join(versions)}; load average before each run "
            f"{min(loads):.1f} to {max(loads):.1f}; {told}{changed}, {days[0]} to "
            f"{days[-1]}, each in `benchmarks/results.json`:\n"
        )

    def text(self, name: str) -> str:
        """What stands in a region. Raises KeyError for a name that there is not."""
        return self.about() if name == MACHINE else self.table(read_tables()[name])


def rendered(text: str, page: Page) -> str:
    """A document with all its regions regenerated."""
    return REGION.sub(
        lambda match: (
            f"<!-- results:{match[1]} -->\n{page.text(match[1])}<!-- /results -->"
        ),
        text,
    )


def documents() -> list[Path]:
    """The files that may have regions."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def write_tables(check: bool = False) -> int:
    """Writes the tables of all documents, or only says which are stale; the exit code."""
    page = Page(read_results(RESULTS))
    stale = 0
    for path in documents():
        before = path.read_text(encoding="utf-8")
        after = rendered(before, page)
        if after == before:
            continue
        stale += 1
        if not check:
            path.write_text(after, encoding="utf-8")
        told = (
            "is not what results.json gives; run `make tables`" if check else "written"
        )
        sys.stdout.write(f"{path.relative_to(ROOT)}: {told}\n")
    return int(check and stale > 0)
