"""Runs the benchmarks, each to its end, and makes the tables of README and docs of what they found.

    python benchmarks/bench.py run [--long] [--only NAME ...] [--out FILE]
    python benchmarks/bench.py tables [--check]

A file holds the benchmarks of one question, each with a name, as `python benchmarks/paper.py
table2_lidar --help`. A benchmark prints one JSON object, whose `failures` are sentences about
missed bars, and ends with 1 if there are any. A run ends with its bars met, with some missed, or
broken: crashed, hung, or without that object. `results.json` keeps the figures that the tables
show, with machine, commit and load; it is rewritten after each run. `tables.md` lists the
runs, `figures.py` makes the tables.
"""

import argparse
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

from nics_drl_bridge.files import format_json, write_text

SCRIPTS = Path(__file__).resolve().parent
ROOT = SCRIPTS.parent
RESULTS = SCRIPTS / "results.json"
FAILURES = "failures"
MET = "met"
MISSED = "missed"
BROKEN = "broken"
MARK = "NICS_BENCHMARK_RUN"
"""The environment variable by which the processes of a run are found again."""
GRACE_S = 10.0
LAST_WORDS = 2000
Given = argparse.Namespace
Result = dict[str, Any]
LIBRARIES = ("numpy", "numba", "scipy", "gymnasium", "torch", "onnxruntime", "mujoco")


# A benchmark: its arguments, its bars, its answer.


@dataclass(frozen=True)
class Bar:
    """What a figure has to reach; NaN and None never do.

    Attributes:
        least: of what meets it.
        most: of what meets it.
        what: the figure in words, where its name does not say it.
    """

    least: float = -math.inf
    most: float = math.inf
    what: str = ""

    def find_missed(self, name: str, figure: float | None) -> list[str]:
        """Returns a sentence if a figure misses it."""
        figure = math.nan if figure is None else figure
        if self.least <= figure <= self.most:
            return []
        ends = [("at least", self.least), ("at most", self.most)]
        told = " and ".join(
            f"{side} {end:g}" for side, end in ends if abs(end) < math.inf
        )
        return [f"{self.what or name} {figure:g}: must be {told}"]


@dataclass(frozen=True)
class Silence:
    """Bar of what went wrong, which should not be there at all."""

    def find_missed(self, name: str, sentence: str) -> list[str]:
        """Returns the sentence."""
        return [f"{name}: {sentence}"]


Bars = Mapping[str, "Bar | Silence | Bars"]
"""Bars by the names of figures, as deep as these; `*` stands for every name that there is."""


@dataclass(frozen=True)
class Control:
    """What makes a benchmark or a campaign fail.

    Attributes:
        what: is taken out.
        bar: words of the bar that must be missed.
        short: arguments, where they are others than those of the short form.
    """

    what: str
    bar: str
    short: str | None = None


@dataclass(frozen=True)
class Benchmark:
    """One of the benchmarks of a file, or a campaign.

    Attributes:
        measure: takes the arguments and returns the figures; its docstring says what is measured.
        bars: of the figures, or what makes them from the figures.
        controls: by their names.
        options: further arguments by their names: the default value, that and a help, or settings
            of `argparse`.
        short: arguments of a short form; None where there is none.
        unsettled: words of the bars that the short form does not settle.
        needs: modules to import.
    """

    measure: Callable[[Given], Result]
    bars: Bars | Callable[[Result], Bars]
    controls: Mapping[str, Control]
    options: Mapping[str, Any] = field(default_factory=dict)
    short: str | None = ""
    unsettled: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    def run(self, words: Sequence[str], doc: str | None = None) -> NoReturn:
        """Measures and answers by arguments; `--short` puts those of the short form before them."""
        parser = make_parser(doc or self.measure.__doc__, self)
        if "--short" in words and self.short is not None:
            words = [*self.short.split(), *words]
        given = parser.parse_args(words)
        result = self.measure(given)
        bars = self.bars(result) if callable(self.bars) else self.bars
        missed = find_missed(result, bars)
        told = {**result, FAILURES: missed}
        sys.stdout.write(format_json(told, None if given.json else 1) + "\n")
        raise SystemExit(1 if missed else 0)


def run_benchmark(benchmarks: Mapping[str, Benchmark]) -> NoReturn:
    """Runs the benchmark that the first argument names, or the only one, by the other arguments."""
    words = sys.argv[1:]
    if len(benchmarks) == 1:
        words = [*benchmarks, *words]
    if not words or words[0] not in benchmarks:
        raise SystemExit(f"name a benchmark: {', '.join(benchmarks)}")
    benchmarks[words[0]].run(words[1:])


def some_of(choices: Sequence[str]) -> dict[str, Any]:
    """Settings of an argument that takes some words of those that there are, by default all."""
    return {"nargs": "+", "choices": list(choices), "default": list(choices)}


def at_most(value: float, what: str = "") -> Bar:
    return Bar(most=value, what=what)


def at_least(value: float, what: str = "") -> Bar:
    return Bar(least=value, what=what)


def find_missed(figures: Mapping[str, Any], bars: Bars, where: str = "") -> list[str]:
    """Returns a sentence for each bar that a figure of its name misses.

    Args:
        figures: that were measured.
        bars: of figures that all have to be there; under `*`, of one at least.
        where: stands before each sentence.
    """
    missed = []
    for name, bar in bars.items():
        names = figures if name == "*" else [name]
        if not names:
            missed.append(f"{where}nothing was measured")
        for each in names:
            if isinstance(bar, Mapping):
                missed += find_missed(figures[each], bar, f"{where}{each}: ")
            else:
                missed += [
                    where + line for line in bar.find_missed(each, figures[each])
                ]
    return missed


def make_parser(doc: str | None, about: Benchmark) -> argparse.ArgumentParser:
    """A parser that is described by the first line of a docstring."""
    controls = {name: control.what for name, control in about.controls.items()}
    parser = argparse.ArgumentParser(
        description=(doc or "").splitlines()[0],
        epilog="controls, which must fail: "
        + "; ".join(f"{k}: {v}" for k, v in controls.items()),
    )
    parser.add_argument("--json", action="store_true", help="print it on one line")
    parser.add_argument(
        "--control",
        nargs="?",
        const=next(iter(controls), None),
        choices=list(controls),
        help="take out what is measured: the bars must then be missed",
    )
    if about.short is not None:
        told = f"the short form: {about.short or 'as it is'}"
        parser.add_argument("--short", action="store_true", help=told)
    for name, settings in about.options.items():
        if not isinstance(settings, Mapping):
            value, told = settings if isinstance(settings, tuple) else (settings, None)
            settings = {"type": type(value), "default": value, "help": told}
            if value is False:
                settings = {"action": "store_true", "help": told}
        parser.add_argument(f"--{name}", **settings)
    return parser


# The runs. `make benchmark` takes half an hour on two cores; LONG=1 takes hours and gives the
# figures of the tables. Some campaigns give figures, too; they run in their folder.

TIMEOUT_S = 600.0
LONG_TIMEOUT_S = 4 * 3600.0


@dataclass(frozen=True)
class Run:
    """One run of a script.

    Attributes:
        what: the script, from the folder of the benchmarks, and the benchmark of it, if of many.
        arguments: within half an hour for all runs.
        long: those of the long version, where they are others.
    """

    what: str
    arguments: str = ""
    long: str | None = None

    @property
    def script(self) -> str:
        """The file."""
        return f"{self.what.split()[0]}.py"

    def words(self, long: bool) -> list[str]:
        """The arguments of the script."""
        chosen = self.long if long and self.long is not None else self.arguments
        return [*self.what.split()[1:], *chosen.split()]


@cache
def read_sections() -> dict[str, list[list[str]]]:
    """The rows of cells of each table of `tables.md`, by name, the head first."""
    text = (SCRIPTS / "tables.md").read_text(encoding="utf-8")
    return {
        section.partition("\n")[0]: [
            [cell.strip() for cell in line[1:-1].split("|")]
            for line in section.splitlines()
            if line.startswith("|") and not line.startswith("|---")
        ]
        for section in text.split("\n## ")[1:]
    }


def read_runs() -> dict[str, Run]:
    """All runs, by name."""
    return {
        name: Run(what, arguments, {"": None, "-": ""}.get(long, long))
        for name, what, arguments, long in read_sections()["runs"][1:]
    }


def list_runs(folder: Path) -> dict[str, Run]:
    """Returns the runs of all scripts in a folder by name; a script without a row runs as it is."""
    runs = read_runs()
    known = {"bench.py", "figures.py", *(run.script for run in runs.values())}
    others = (path for path in sorted(folder.glob("*.py")) if path.name not in known)
    there = {name: run for name, run in runs.items() if (folder / run.script).exists()}
    return there | {path.stem: Run(path.stem) for path in others}


# A run: a benchmark in a process of its own, to its end.


def describe_machine() -> dict[str, Any]:
    """The machine, and the versions of what is measured with."""
    libraries = {}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            libraries[name] = version(name)
    return {
        "cpu": read_field("/proc/cpuinfo", "model name") or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(
            os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1
        ),
        "python": platform.python_version(),
        "libraries": libraries,
    }


def read_field(file: str, key: str) -> str:
    """The first value of a key in a file of /proc, or nothing where there is none."""
    rows = (line.partition(":") for line in Path(file).read_text().splitlines())
    return next((value.strip() for name, _, value in rows if name.strip() == key), "")


def describe_commit(folder: Path) -> dict[str, Any]:
    """The commit of a working tree, and whether more than results and text changed since."""
    order = "git status --porcelain=2 --branch --untracked-files=no -- ."
    left_out = (":(exclude)benchmarks/results.json", ":(exclude)*.md")
    words = [*order.split(), *left_out]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    commit = re.search(r"^# branch.oid (\w{12})", done.stdout, re.MULTILINE)
    changed = re.search(r"^[^#]", done.stdout, re.MULTILINE)
    if commit is None:
        return {"commit": None, "dirty": None}
    return {"commit": commit[1], "dirty": changed is not None}


def find_processes(mark: str) -> list[int]:
    """The living processes that a run has started, wherever they have gone since."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is somebody else's
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
            environment = (folder / "environ").read_bytes().split(b"\0")
            if state != "Z" and wanted in environment:
                found.append(int(folder.name))
    return found


def end_processes(mark: str, grace_s: float = GRACE_S) -> int:
    """Ends what a run left behind; returns how many processes that were."""
    left = find_processes(mark)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        for pid in find_processes(mark):
            with suppress(ProcessLookupError):
                os.kill(pid, number)
        deadline = time.monotonic() + grace_s
        while find_processes(mark) and time.monotonic() < deadline:
            time.sleep(0.05)
    return len(left)


def judge(code: int | None, printed: str, last: str) -> dict[str, Any]:
    """State, failures, result and error of a run.

    Args:
        code: exit code; None if it took too long.
        printed: on standard output, whose last line is the JSON object.
        last: words, for an error.
    """
    result = None
    with suppress(ValueError, RecursionError, IndexError):
        result = json.loads(
            printed.strip().splitlines()[-1], parse_constant=lambda _: None
        )
    failures = result.pop(FAILURES, None) if isinstance(result, dict) else None
    error = None
    if code is None:
        error = "was ended, since it took too long"
    elif code not in (0, 1):
        error = f"ended with exit code {code}: {last}"
    elif not isinstance(failures, list):
        error = f"printed no JSON object with `failures`: {last}"
    elif not result:
        error = "measured nothing: its JSON object holds no figure"
    failures = [str(each) for each in failures or ()] if error is None else []
    state = MISSED if code or failures else MET
    return {
        "state": state if error is None else BROKEN,
        "failures": failures,
        "error": error,
        "result": result if error is None else None,
    }


def run_one(
    script: Path, arguments: Sequence[str], timeout_s: float, grace_s: float
) -> dict[str, Any]:
    """Runs a script to its end, or ends it; no process of it stays."""
    mark = uuid.uuid4().hex
    entry = {
        "arguments": list(arguments),
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "load": round(os.getloadavg()[0], 2),
    }
    began = time.monotonic()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen(
            [sys.executable, str(script), *arguments, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=out,  # files, since a pipe can clog
            stderr=err,
            cwd=ROOT,
            env={**os.environ, MARK: mark},
            start_new_session=True,
        )
        code = None
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            end_processes(mark, grace_s)
            process.wait()
        printed, said = (read_all(file) for file in (out, err))
    last = (said.strip() or printed.strip() or "no message")[-LAST_WORDS:]
    seconds = round(time.monotonic() - began, 1)
    return {**entry, "seconds": seconds, **judge(code, printed, last)}


def read_all(file: Any) -> str:
    """All that was written into a file."""
    file.seek(0)
    return str(file.read().decode("utf-8", errors="replace"))


def write_results(runs: Mapping[str, Any], file: Path) -> None:
    """Replaces the file at once or not at all."""
    text = format_json({"runs": dict(sorted(runs.items()))}, indent=1)
    write_text(file, f"{text}\n")


def read_results(file: Path) -> dict[str, Any]:
    """The runs of a file; ends with a sentence if it is none of ours."""
    if not file.exists():
        return {}
    try:
        runs = json.loads(file.read_text(encoding="utf-8"))["runs"]
        return {
            name: {**run, "machine": dict(run["machine"])} for name, run in runs.items()
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        raise SystemExit(
            f"{file}: holds no results; remove it, or name another by --out."
        ) from None


def keep_figures(result: Any, paths: Sequence[Sequence[str]]) -> Any:
    """The part of a result to which some path leads; what no table shows is left out."""
    if () in {tuple(path) for path in paths} or not isinstance(result, Mapping | list):
        return result
    rows = enumerate(result) if isinstance(result, list) else result.items()
    kept = {}
    for key, value in rows:
        inside = [path[1:] for path in paths if path[0] in (str(key), "*")]
        if inside:
            kept[str(key)] = keep_figures(value, inside)
    return kept


def summarize(name: str, entry: Mapping[str, Any]) -> str:
    """A run in a line, with the first thing that is wrong with it."""
    wrong = " ".join((entry["error"] or "; ".join(entry["failures"][:1])).split())
    return f"{name:<30}{entry['state']:<8}{entry['seconds']:>8.1f} s  {wrong[:160]}\n"


def run_all(given: Given, plan: Mapping[str, Any]) -> int:
    """Runs what is asked for, one after the other, and writes the file after each."""
    from figures import paths_of

    entries = {
        name: run for name, run in read_results(given.out).items() if name in plan
    }
    about = {"machine": describe_machine(), **describe_commit(ROOT)}
    chosen = [name for name in plan if name in (given.only or plan)]
    states = []
    for name in chosen:
        run = plan[name]
        words = run.words(given.long)
        timeout_s = given.timeout or (LONG_TIMEOUT_S if given.long else TIMEOUT_S)
        sys.stderr.write(f"{name}: {run.script} {' '.join(words)}\n")
        entry = {
            "script": Path(run.script).name,
            **about,
            **run_one(given.scripts / run.script, words, timeout_s, given.grace),
        }
        paths = paths_of(name)
        if paths and entry["result"]:
            entry["result"] = keep_figures(entry["result"], paths)
        entries[name] = entry
        write_results(entries, given.out)
        sys.stdout.write(summarize(name, entry))
        states.append(entry["state"])
    sys.stdout.write(
        f"{states.count(MET)} of {len(states)} met their bars: {given.out}\n"
    )
    return int(states.count(MET) < len(states))


def main() -> None:
    """Runs benchmarks or makes tables."""
    from figures import write_tables

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="run benchmarks")
    run.add_argument("--only", nargs="*", metavar="NAME", help="these; others are kept")
    run.add_argument("--long", action="store_true", help="hours instead of minutes")
    run.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    run.add_argument("--timeout", type=float, help="seconds for each")
    run.add_argument(
        "--grace", type=float, default=GRACE_S, help="seconds between signals that end"
    )
    run.add_argument("--scripts", type=Path, default=SCRIPTS, help="their folder")
    made = commands.add_parser("tables", help="make the tables of README and docs")
    made.add_argument("--check", action="store_true", help="say which are stale")
    given = parser.parse_args()
    if given.command == "tables":
        raise SystemExit(write_tables(given.check))
    plan = list_runs(given.scripts)
    unknown = [name for name in given.only or () if name not in plan]
    if unknown:
        parser.error(f"{unknown[0]!r} is no benchmark; there are {', '.join(plan)}.")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = run_all(given, plan)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; what was measured before is in the file\n")
        code = 130
    raise SystemExit(code)


if __name__ == "__main__":
    main()
