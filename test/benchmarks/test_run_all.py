from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from .runs import BENCHMARKS

DEADLINE_S = 60.0
MET = 'import sys\nprint(\'{"figure": 1.5, "failures": []}\')\n'
MISSED = 'import sys\nprint(\'{"figure": 9.5, "failures": ["figure: 9.5, bar 2"]}\')\nsys.exit(1)\n'


@pytest.fixture
def scripts(tmp_path) -> Path:
    folder = tmp_path / "benchmarks"
    folder.mkdir()
    return folder


def command(scripts: Path, *options: str) -> list[str]:
    out = str(scripts / "results.json")
    words = ["-m", "measuring.run_all", "--scripts", str(scripts), "--out", out]
    return [sys.executable, *words, *options]


def run(scripts: Path, *options: str) -> tuple[subprocess.CompletedProcess[str], dict]:
    done = subprocess.run(
        command(scripts, *options),
        cwd=BENCHMARKS,
        capture_output=True,
        text=True,
        timeout=200,
    )
    file = scripts / "results.json"
    return done, json.loads(file.read_text()) if file.exists() else {}


def until(condition) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_bars_that_are_met_end_with_0_and_stand_in_the_file_with_machine_commit_and_load(
    scripts,
):
    (scripts / "good.py").write_text(MET)
    done, found = run(scripts)
    assert done.returncode == 0
    assert "1 of 1 met their bars" in done.stdout
    assert set(found) == {"runs"}
    entry = found["runs"]["good"]
    assert entry["machine"]["cores"] == os.cpu_count()
    assert entry["machine"]["libraries"]["numpy"]
    assert entry["result"] == {"figure": 1.5}
    assert (entry["state"], entry["exit_code"], entry["failures"]) == ("met", 0, [])
    assert (entry["script"], entry["arguments"], entry["quick"]) == (
        "good.py",
        [],
        False,
    )
    assert len(entry["load_before"]) == len(entry["load_after"]) == 3
    assert entry["seconds"] >= 0.0
    assert entry["started"].endswith("+00:00")
    assert {"commit", "dirty"} < set(entry)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "state", "told"),
    [
        (MISSED, "missed", "figure: 9.5, bar 2"),
        (MET + "sys.exit(1)\n", "missed", ""),
        (MISSED.replace("sys.exit(1)", ""), "missed", "figure: 9.5, bar 2"),
        ("raise RuntimeError('no lidar')\n", "broken", "no lidar"),
        (MET + "sys.exit(2)\n", "broken", "exit code 2"),
        ("print('what a day')\n", "broken", "printed no JSON object: what a day"),
        ("print('[1, 2]')\n", "broken", "printed no JSON object"),
        ("print('{\"figure\": 1.5')\n", "broken", "printed no JSON object"),
        (
            "import sys\nsys.stdout.buffer.write(b'\\xff\\x00\\x80')\n",
            "broken",
            "no JSON object",
        ),
        (
            "print('{\"figure\": 1.5}')\n",
            "broken",
            "does not say which bars were missed",
        ),
        (
            'print(\'{"figure": 1, "failures": 5}\')\n',
            "broken",
            "`failures` is '5', no list",
        ),
        ('print(\'{"figure": 1, "failures": [5]}\')\n', "missed", "5"),
        ("print('{\"failures\": []}')\n", "broken", "measured nothing"),
        ("print('[' * 100000)\n", "broken", "printed no JSON object"),
        ("", "broken", "printed no JSON object: no message"),
        (
            "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n",
            "broken",
            "by signal 9",
        ),
        ("import os\nos.abort()\n", "broken", "by signal 6"),
    ],
)
def test_whatever_a_benchmark_does_the_next_is_run_and_it_stands_in_the_file(
    scripts, content, state, told
):
    (scripts / "a_bad_one.py").write_text(content)
    (scripts / "good.py").write_text(MET)
    done, found = run(scripts)
    assert done.returncode == 1
    assert "1 of 2 met their bars" in done.stdout
    assert found["runs"]["good"]["state"] == "met"
    entry = found["runs"]["a_bad_one"]
    assert entry["state"] == state
    assert told in " ".join([*entry["failures"], entry["error"] or ""])
    assert f"a_bad_one                 {state}" in done.stdout


HANGS = """
import os, subprocess, sys
from pathlib import Path
words = [sys.executable, "-c", "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN);"
    "signal.signal(signal.SIGTERM, signal.SIG_IGN); print(1, flush=True); time.sleep(600)"]
child = subprocess.Popen(words, start_new_session=True, stdout=subprocess.PIPE)
child.stdout.readline()
Path(__file__).with_suffix(".pid").write_text(str(child.pid))
child.stdout = None
"""


@pytest.mark.campaign
def test_a_benchmark_that_hangs_is_ended_with_all_its_children(scripts):
    (scripts / "hangs.py").write_text(HANGS + "child.wait()\n")
    (scripts / "later.py").write_text(MET)
    done, found = run(scripts, "--timeout", "3")
    assert done.returncode == 1
    assert found["runs"]["hangs"]["state"] == "broken"
    assert "took too long" in found["runs"]["hangs"]["error"]
    assert found["runs"]["hangs"]["exit_code"] is None
    assert found["runs"]["later"]["state"] == "met"
    assert not alive(int((scripts / "hangs.pid").read_text()))


@pytest.mark.campaign
def test_what_a_benchmark_leaves_behind_is_ended_and_counted(scripts):
    (scripts / "leaves.py").write_text(
        HANGS + MET + "os._exit(0)\n".replace("os._", "sys.stdout.flush(); os._")
    )
    done, found = run(scripts)
    assert done.returncode == 0
    assert found["runs"]["leaves"]["left_behind"] == 1
    assert not alive(int((scripts / "leaves.pid").read_text()))


def test_numbers_that_json_does_not_know_are_null(scripts):
    (scripts / "odd.py").write_text(
        'print(\'{"a": NaN, "b": [Infinity], "failures": []}\')\n'
    )
    _, found = run(scripts)
    assert found["runs"]["odd"]["result"] == {"a": None, "b": [None]}
    assert "NaN" not in (scripts / "results.json").read_text()


@pytest.mark.campaign
def test_some_are_run_again_and_the_others_keep_commit_and_load(scripts):
    for name in ("first", "second"):
        (scripts / f"{name}.py").write_text(MET)
    _, before = run(scripts)
    (scripts / "second.py").write_text(MISSED)
    done, found = run(scripts, "--only", "second")
    assert done.returncode == 1
    assert found["runs"]["first"] == before["runs"]["first"]
    assert found["runs"]["second"]["result"] == {"figure": 9.5}


@pytest.mark.campaign
def test_results_of_scripts_that_are_gone_go(scripts):
    for name in ("first", "second"):
        (scripts / f"{name}.py").write_text(MET)
    run(scripts)
    (scripts / "first.py").unlink()
    _, found = run(scripts, "--only", "second")
    assert list(found["runs"]) == ["second"]


def test_a_name_that_no_benchmark_has_is_refused_before_anything_is_run(scripts):
    (scripts / "good.py").write_text(MET)
    done, found = run(scripts, "--only", "nonsense")
    assert (done.returncode, found) == (2, {})
    assert "'nonsense' is no benchmark; there are good." in done.stderr


@pytest.mark.parametrize(
    "content", ["[]", "{", '{"runs": 3}', '{"runs": {"good": {}}}']
)
def test_a_file_that_holds_no_results_is_not_written_over(scripts, content):
    (scripts / "good.py").write_text(MET)
    (scripts / "results.json").write_text(content)
    done = subprocess.run(
        command(scripts), cwd=BENCHMARKS, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 1
    assert "holds no results" in done.stderr
    assert "Traceback" not in done.stderr
    assert (scripts / "results.json").read_text() == content


def test_results_of_another_machine_stay_what_they_are_beside_those_of_this_one(
    scripts,
):
    (scripts / "good.py").write_text(MET)
    (scripts / "other.py").write_text(MET)
    _, found = run(scripts)
    found["runs"]["other"]["machine"]["cpu"] = "Zuse Z3"
    (scripts / "results.json").write_text(json.dumps(found))
    _, after = run(scripts, "--only", "good")
    assert after["runs"]["other"] == found["runs"]["other"]
    assert after["runs"]["good"]["machine"]["cpu"] != "Zuse Z3"


@pytest.mark.campaign
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_ends_its_children_and_keeps_what_was_measured(
    scripts, number
):
    (scripts / "a_good_one.py").write_text(MET)
    (scripts / "hangs.py").write_text(HANGS + "child.wait()\n")
    runner = subprocess.Popen(
        command(scripts),
        cwd=BENCHMARKS,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    until((scripts / "hangs.pid").exists)
    until((scripts / "hangs.pid").read_text)
    runner.send_signal(number)
    _, said = runner.communicate(timeout=100)
    assert runner.returncode == 130
    assert "interrupted" in said
    assert "Traceback" not in said
    assert not alive(int((scripts / "hangs.pid").read_text()))
    found = json.loads((scripts / "results.json").read_text())
    assert list(found["runs"]) == ["a_good_one"]


def test_a_write_that_fails_leaves_the_file_as_it_was(scripts, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from measuring import run_all

    file = scripts / "results.json"
    run_all.write({"runs": {}}, file)
    before = file.read_bytes()
    with pytest.raises(ValueError, match="Out of range"):
        run_all.write({"runs": {"a": float("nan")}}, file)
    assert file.read_bytes() == before
    assert list(scripts.iterdir()) == [file]


def test_the_plan_names_scripts_that_there_are_and_options_that_they_have(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from measuring.plan import RUNS, runs_of

    assert {run.script for run in RUNS.values()} <= {
        path.name for path in BENCHMARKS.glob("*.py")
    }
    every = runs_of(BENCHMARKS)
    assert {run.script for run in every.values()} == {
        p.name for p in BENCHMARKS.glob("*.py")
    }
    for name, run in every.items():
        source = (BENCHMARKS / run.script).read_text()
        for option in [*run.full, *run.quick]:
            assert not option.startswith("--") or f'"{option}"' in source, (
                f"{name}: {option}"
            )
