"""The runner of the benchmarks, their bars, and the tables of what they found."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
DEADLINE_S = 60.0
MET = 'import sys\nprint(\'{"figure": 1.5, "failures": []}\')\n'
MISSED = (
    'import sys\nprint(\'{"figure": 9.5, "failures": ["figure 9.5"]}\')\nsys.exit(1)\n'
)
HANGS = """
import os, subprocess, sys
from pathlib import Path
words = [sys.executable, "-c", "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN);"
    "signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"]
child = subprocess.Popen(words, start_new_session=True, stdout=subprocess.PIPE)
child.stdout.readline()
Path(__file__).with_suffix(".pid").write_text(str(child.pid))
child.wait()
"""


@pytest.fixture(autouse=True)
def path(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])


def command(scripts: Path, *options: str) -> list[str]:
    out = ("--scripts", str(scripts), "--out", str(scripts / "results.json"))
    return [sys.executable, str(BENCHMARKS / "bench.py"), "run", *out, *options]


def run(scripts: Path, *options: str) -> tuple[subprocess.CompletedProcess[str], dict]:
    done = subprocess.run(
        command(scripts, *options), capture_output=True, text=True, timeout=200
    )
    file = scripts / "results.json"
    return done, json.loads(file.read_text())["runs"] if file.exists() else {}


def lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_a_run_stands_in_the_file_with_machine_commit_and_load(tmp_path):
    (tmp_path / "good.py").write_text(MET)
    done, found = run(tmp_path)
    assert done.returncode == 0
    entry = found["good"]
    assert (entry["state"], entry["result"]) == ("met", {"figure": 1.5})
    assert entry["machine"]["cores"] == os.cpu_count()
    assert entry["machine"]["libraries"]["numpy"]
    assert {"commit", "dirty", "load", "started", "seconds"} < set(entry)


@pytest.mark.parametrize(
    ("code", "printed", "state", "told"),
    [
        (0, '{"figure": 1, "failures": []}', "met", ""),
        (1, '{"figure": 9, "failures": ["figure 9"]}', "missed", "figure 9"),
        (0, '{"figure": 9, "failures": ["figure 9"]}', "missed", "figure 9"),
        (2, '{"figure": 1, "failures": []}', "broken", "code 2: last"),
        (-9, "", "broken", "code -9: last"),
        (None, "", "broken", "too long"),
        (0, "", "broken", "no JSON object"),
        (0, "what a day", "broken", "no JSON object"),
        (0, "[" * 100000, "broken", "no JSON object"),
        (0, '{"figure": 1}', "broken", "no JSON object with `failures`"),
        (0, '{"failures": []}', "broken", "measured nothing"),
    ],
)
def test_a_run_is_met_missed_or_broken(code, printed, state, told):
    import bench

    found = bench.judge(code, printed, "last")
    assert found["state"] == state
    assert told in " ".join([*found["failures"], found["error"] or ""])


def test_numbers_that_json_does_not_know_are_null():
    import bench

    found = bench.judge(0, '{"a": NaN, "b": [Infinity], "failures": []}', "")
    assert found["result"] == {"a": None, "b": [None]}


@pytest.mark.slow
def test_a_benchmark_that_hangs_is_ended_with_its_children_and_the_next_is_run(
    tmp_path,
):
    (tmp_path / "hangs.py").write_text(HANGS)
    (tmp_path / "later.py").write_text(MISSED)
    done, found = run(tmp_path, "--timeout", "3", "--grace", "0.3")
    assert done.returncode == 1
    assert (found["hangs"]["state"], found["later"]["state"]) == ("broken", "missed")
    assert "too long" in found["hangs"]["error"]
    assert not lives(int((tmp_path / "hangs.pid").read_text()))


@pytest.mark.slow
def test_an_interrupted_run_ends_its_children_and_keeps_what_was_measured(tmp_path):
    (tmp_path / "a_good_one.py").write_text(MET)
    (tmp_path / "hangs.py").write_text(HANGS)
    runner = subprocess.Popen(
        command(tmp_path, "--grace", "0.3"),
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    pid = tmp_path / "hangs.pid"
    deadline = time.monotonic() + DEADLINE_S
    while not (pid.exists() and pid.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    runner.send_signal(signal.SIGINT)
    _, said = runner.communicate(timeout=100)
    assert runner.returncode == 130
    assert "Traceback" not in said
    assert not lives(int(pid.read_text()))
    found = json.loads((tmp_path / "results.json").read_text())["runs"]
    assert list(found) == ["a_good_one"]


def test_some_are_run_again_others_stay_and_results_of_scripts_that_are_gone_go(
    tmp_path,
):
    for name in ("first", "second", "third"):
        (tmp_path / f"{name}.py").write_text(MET)
    _, before = run(tmp_path)
    (tmp_path / "second.py").write_text(MISSED)
    (tmp_path / "third.py").unlink()
    done, found = run(tmp_path, "--only", "second")
    assert done.returncode == 1
    assert list(found) == ["first", "second"]
    assert found["first"] == before["first"]
    assert found["second"]["result"] == {"figure": 9.5}


def test_a_name_that_no_benchmark_has_is_refused_before_anything_is_run(tmp_path):
    (tmp_path / "good.py").write_text(MET)
    done, found = run(tmp_path, "--only", "nonsense")
    assert (done.returncode, found) == (2, {})
    assert "'nonsense'" in done.stderr


@pytest.mark.parametrize("content", ["[]", "{", '{"runs": 3}', '{"runs": {"a": {}}}'])
def test_a_file_that_holds_no_results_is_not_written_over(tmp_path, content):
    import bench

    file = tmp_path / "results.json"
    file.write_text(content)
    with pytest.raises(SystemExit, match="holds no results"):
        bench.read_results(file)


@pytest.mark.parametrize("figure", [2.5, math.nan, math.inf])
def test_a_figure_that_is_too_large_or_no_number_misses_its_bar(figure):
    import bench

    bars = {"*": {"loss": bench.at_most(2.0, "loss [%]")}}
    assert bench.find_missed({"car": {"loss": 2.0}}, bars) == []
    (line,) = bench.find_missed({"car": {"loss": figure}}, bars)
    assert line == f"car: loss [%] {figure:g}: must be at most 2"
    assert bench.find_missed({"loss": math.nan}, {"loss": bench.at_least(0.0)})


def test_nothing_measured_and_a_failure_that_is_told_miss_their_bars():
    import bench

    bars = {"robots": {"*": bench.at_least(1.0)}, "failed": bench.Silence()}
    missed = bench.find_missed({"robots": {}, "failed": "no lidar"}, bars)
    assert missed == ["robots: nothing was measured", "failed: no lidar"]


ENTRY = {
    "script": "parity.py",
    "machine": {"cores": 2, "cpu": "Zuse Z3", "memory_gb": 24.7, "python": "3.11.7"},
    "commit": "0123456789ab",
    "started": "2026-11-27T09:00:00+00:00",
    "dirty": False,
    "load": 1.5,
    "state": "met",
    "failures": [],
    "error": None,
    "result": {
        "rate": 487654.3,
        "small": 1.34e-06,
        "share": 0.9841,
        "none": None,
        "robots": {"a": {"rmse": 0.001}, "b": {"rmse": 0.003}},
        "rows": {"0": {"ratio": 9.44}, "1": {"ratio": 13.3}},
        "nested": {},
        "name": "office",
    },
}


def page(**changes):
    from figures import Page

    return Page({"parity": {**ENTRY, **changes}})


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("{rate:.1e} a second", "4.9e5 a second"),
        ("{rate:,.0f}", "487,654"),
        ("{small:.1e}", "1.3e-6"),
        ("{share:.1%}", "98.4 %"),
        ("{share x100:.0f}", "98"),
        (
            "{min robots.*.rmse x1000:.0f} to {max robots.*.rmse x1000:.0f} mm",
            "1 to 3 mm",
        ),
        ("{max rows.*.ratio:.1f}, {rows.0.ratio:.1f}", "13.3, 9.4"),
        ("{name}", "office"),
        ("{nothing}", "not measured"),
        ("{none}", "not measured"),
        ("{rows.7.ratio}", "not measured"),
        ("{max nested.*.rmse}", "not measured"),
        ("{name:.1f}", "not measured"),
        ("{rate of soak}", "not measured"),
    ],
)
def test_a_cell_is_written_from_what_was_measured_or_says_that_it_was_not(
    template, text
):
    assert page().cell(template, "parity")[0] == text


def test_a_table_shows_what_is_wrong_with_its_runs():
    from figures import Table

    table = Table(("what", ""), (("parity", "rate", "{rate:.1e}"), ("parity", "", "x")))
    missed = {"state": "missed", "failures": ["a: 1", "b: 2", "c: 3", "d: 4"]}
    told = page(**missed).table(table)
    assert "| rate | 4.9e5† |" in told
    assert told.endswith("† `parity.py` missed: a: 1; b: 2; and 2 more\n")
    broken = page(state="broken", result=None, error="was ended").table(table)
    assert "| rate | not measured |" in broken
    assert "† `parity.py` broken: was ended" in broken
    quiet = page(**missed).table(Table(table.head, table.rows, notes=False))
    assert quiet.endswith("| rate | 4.9e5† |\n| | x |\n")


def test_a_region_is_made_anew_and_all_else_stays(monkeypatch):
    import figures
    from figures import Table

    table = Table(("",), (("parity", "{rate:.0e}"),))
    monkeypatch.setattr(figures, "read_tables", lambda: {"parity": table})
    before = "a\n\n<!-- results:parity -->\nold\n<!-- /results -->\n\nb\n"
    new = before.replace("old", "| |\n|---|\n| 5e5 |")
    assert figures.rendered(before, page()) == new
    with pytest.raises(KeyError):
        figures.rendered("<!-- results:nonsense -->\n<!-- /results -->", page())


def test_rows_are_of_runs_that_there_are_and_as_long_as_their_head():
    from bench import read_runs
    from figures import read_tables

    assert len(read_tables()) == 22
    for name, table in read_tables().items():
        for run, *cells in table.rows:
            assert run in read_runs(), name
            assert len(cells) == len(table.head), f"{name}: {cells}"


def test_the_tables_are_what_results_json_gives():
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "bench.py"), "tables", "--check"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
