"""Runs every benchmark to its end, whatever one of them says, and writes results.json.

    python -m measuring.run_all [--quick] [--only NAME ...]

A run ends with its bars met, with some missed, or broken: crashed, hung, killed, or without one
JSON object on standard output. All that is kept, with what was measured, its machine, the commit
and the load: bars are ratios within a run, so runs on several machines may stand in one file. It is
rewritten after each run, so what was measured before an interruption stays. Ends with 1 if any
run missed a bar or broke, 130 when it was interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from measuring.machine import commit_of, describe, load
from measuring.plan import Run, runs_of
from measuring.verdict import finite

SCRIPTS = Path(__file__).resolve().parents[1]
RESULTS = SCRIPTS / "results.json"
QUICK_RESULTS = SCRIPTS.parent / "runs" / "quick_results.json"
"""A short pass does not replace the figures that are told."""
MET = "met"
MISSED = "missed"
BROKEN = "broken"
MARK = "NICS_BENCHMARK_RUN"
"""The environment variable by which the processes of a run are found again."""
GRACE_S = 10.0
LAST_WORDS = 2000


def marked(mark: str) -> list[int]:
    """The processes that a run has started, wherever they have gone since."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            environment = (folder / "environ").read_bytes().split(b"\0")
        except OSError:  # it has ended, or is somebody else's
            continue
        if wanted in environment and not is_zombie(folder):
            found.append(int(folder.name))
    return found


def is_zombie(folder: Path) -> bool:
    """Whether a process has ended, and only its parent has not asked for its exit code."""
    try:
        return (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def sweep(mark: str) -> int:
    """Ends what a run left behind; says how many processes that were."""
    left = marked(mark)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        for pid in marked(mark):
            try:
                os.kill(pid, number)
            except ProcessLookupError:
                continue
        deadline = time.monotonic() + GRACE_S
        while marked(mark) and time.monotonic() < deadline:
            time.sleep(0.05)
    return len(left)


def object_in(printed: str) -> dict[str, Any] | None:
    """The JSON object that is the last line, if it is one."""
    lines = printed.strip().splitlines()
    try:
        found = json.loads(lines[-1]) if lines else None
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def judged(
    code: int | None, result: dict[str, Any] | None, last: str
) -> dict[str, Any]:
    """State, failures, result and error of a run that ended with a code, `None` if it was ended."""
    told = (result or {}).pop("failures", None)
    failures = [str(each) for each in told] if isinstance(told, list) else []
    state = BROKEN
    error = None
    if code is None:
        error = "was ended, since it took too long"
    elif code not in (0, 1):
        how = (
            f"was killed by signal {-code}"
            if code < 0
            else f"ended with exit code {code}"
        )
        error = f"{how}: {last}"
    elif result is None:
        error = f"ended with exit code {code} and printed no JSON object: {last}"
    elif not isinstance(told, list):
        error = f"does not say which bars were missed: `failures` is {str(told)[:40]!r}, no list"
    elif not result:
        error = "measured nothing: its JSON object holds no figure"
    else:
        state = MISSED if code or failures else MET
    return {
        "exit_code": code,
        "state": state,
        "failures": failures,
        "error": error,
        "result": finite(result),
    }


def run_one(script: Path, arguments: Sequence[str], timeout_s: float) -> dict[str, Any]:
    """Runs a script to its end, or ends it; no process of it stays."""
    mark = uuid.uuid4().hex
    before = load()
    began = time.monotonic()
    started = datetime.now(timezone.utc)
    with (
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
    ):  # no pipe can clog
        process = subprocess.Popen(
            [sys.executable, str(script), "--json", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            cwd=SCRIPTS.parent,
            env={**os.environ, MARK: mark},
            start_new_session=True,
        )
        code = None
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            left = sweep(mark)
            process.wait()
        printed, said = (text_of(file) for file in (out, err))
    last = (said.strip() or printed.strip() or "no message")[-LAST_WORDS:]
    return {
        "arguments": list(arguments),
        "started": started.isoformat(timespec="seconds"),
        "seconds": round(time.monotonic() - began, 1),
        "load_before": before,
        "load_after": load(),
        "left_behind": left if code is not None else 0,
        **judged(code, object_in(printed), last),
    }


def text_of(file: Any) -> str:
    """All that was written into a file."""
    file.seek(0)
    return str(file.read().decode("utf-8", errors="replace"))


def write(results: Mapping[str, Any], file: Path) -> None:
    """Replaces the file at once or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        with part.open("w", encoding="utf-8") as stream:
            stream.write(json.dumps(results, indent=1, allow_nan=False) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def known(file: Path) -> dict[str, Any]:
    """The runs that the file holds already; ends with a sentence if it is none of ours."""
    if not file.exists():
        return {}
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        return {
            name: {**entry, "machine": dict(entry["machine"])}
            for name, entry in found["runs"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise SystemExit(
            f"{file}: holds no results; remove it, or name another (make benchmark "
            "OUT=runs/results.json, or --out of the runner)."
        ) from None


def line_of(name: str, entry: Mapping[str, Any]) -> str:
    """A run in a line, with the first thing that is wrong with it."""
    wrong = entry["error"] or "; ".join(entry["failures"][:1])
    wrong = " ".join(wrong.split())
    wrong = wrong if len(wrong) <= 160 else f"{wrong[:160]} ..."
    return (
        f"{name:<26}{entry['state']:<8}{entry['seconds']:>8.1f} s  {wrong}".rstrip()
        + "\n"
    )


def run_all(
    runs: Mapping[str, Run], given: argparse.Namespace
) -> dict[str, dict[str, Any]]:
    """Runs all, one after the other, and writes the file after each."""
    commit = commit_of(given.scripts.parent)
    machine = describe()
    every = runs_of(given.scripts)
    entries = {name: one for name, one in known(given.out).items() if name in every}
    done: dict[str, dict[str, Any]] = {}
    for k, (name, run) in enumerate(runs.items(), 1):
        arguments = run.quick if given.quick else run.full
        words = " ".join([run.script, *arguments])
        sys.stderr.write(f"[{k}/{len(runs)}] {name}: {words}\n")
        timeout_s = given.timeout or run.timeout_s
        about = {
            "script": run.script,
            "quick": given.quick,
            "machine": machine,
            **commit,
        }
        entry = {**about, **run_one(given.scripts / run.script, arguments, timeout_s)}
        done[name] = entries[name] = entry
        write({"runs": dict(sorted(entries.items()))}, given.out)
        sys.stderr.write(f"[{k}/{len(runs)}] {line_of(name, entry)}")
    return done


def ask(arguments: Sequence[str] | None) -> argparse.Namespace:
    """What is asked for; `runs` are those that it names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--only", nargs="*", metavar="NAME", help="these; other results are kept"
    )
    parser.add_argument(
        "--quick", action="store_true", help="short versions, recorded as such"
    )
    parser.add_argument(
        "--list", action="store_true", help="print the names of the runs"
    )
    parser.add_argument("--out", type=Path, help="file of the results")
    parser.add_argument(
        "--timeout", type=float, help="seconds for each, instead of its own"
    )
    parser.add_argument(
        "--scripts", type=Path, default=SCRIPTS, help="folder of the benchmarks"
    )
    given = parser.parse_args(arguments)
    given.out = given.out or (QUICK_RESULTS if given.quick else RESULTS)
    given.scripts, every = given.scripts.resolve(), runs_of(given.scripts.resolve())
    named = {name for name in given.only or () if name not in every}
    # A script that is run several times may be named itself.
    of = {
        name: [
            each for each, run in every.items() if Path(run.script).name == f"{name}.py"
        ]
        for name in named
    }
    unknown = [name for name, found in of.items() if not found]
    if unknown:
        parser.error(f"{unknown[0]!r} is no benchmark; there are {', '.join(every)}.")
    wanted = {
        *(given.only or every),
        *(each for found in of.values() for each in found),
    }
    given.runs = {name: run for name, run in every.items() if name in wanted}
    return given


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs what is asked for, and prints a table."""
    given = ask(arguments)
    if given.list:
        sys.stdout.write("".join(f"{name}\n" for name in given.runs))
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        done = run_all(given.runs, given)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; what was measured before is in the file\n")
        raise SystemExit(130) from None
    for name, entry in done.items():
        sys.stdout.write(line_of(name, entry))
    wrong = [name for name, entry in done.items() if entry["state"] != MET]
    sys.stdout.write(
        f"{len(done) - len(wrong)} of {len(done)} met their bars: {given.out}\n"
    )
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
