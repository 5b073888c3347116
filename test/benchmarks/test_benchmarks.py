"""Every benchmark meets its bars in its short form, and misses the named one under each control."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
FILES = ("paper", "speed", "fidelity", "policies", "first_hour")
RECORDINGS = BENCHMARKS.parents[1] / "shared" / "recordings"
SPECIAL = {"real_drives": not RECORDINGS.is_dir()}
TIMEOUT_S = {"first_hour": 3500.0}


def list_benchmarks():
    sys.path.insert(0, str(BENCHMARKS))
    for file in FILES:
        for name, benchmark in import_module(file).BENCHMARKS.items():
            yield file, name, benchmark


def list_marks(name, benchmark, control=""):
    lacking = [need for need in benchmark.needs if find_spec(need) is None]
    lacking += [special for special in (name, control) if SPECIAL.get(special)]
    marks = [
        pytest.mark.timeout(TIMEOUT_S.get(name, 600.0) + 60.0),
        pytest.mark.skipif(bool(lacking), reason=f"needs {', '.join(lacking)}"),
    ]
    return [*marks, pytest.mark.ros] if "rclpy" in benchmark.needs else marks


BY_NAME = {name: (file, benchmark) for file, name, benchmark in list_benchmarks()}
SHORT_FORMS = [
    pytest.param(name, marks=list_marks(name, benchmark))
    for name, (_, benchmark) in BY_NAME.items()
    if benchmark.short is not None
]
CONTROLS = [
    pytest.param(name, control, marks=list_marks(name, benchmark, control))
    for name, (_, benchmark) in BY_NAME.items()
    for control in benchmark.controls
]


def run(name, *words):
    """The exit code of a benchmark, and the bars that it says it missed."""
    file, _ = BY_NAME[name]
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / f"{file}.py"), name, "--json", *words],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S.get(name, 600.0),
    )
    assert done.stdout.count("\n") == 1, done.stdout + done.stderr
    return done.returncode, json.loads(done.stdout)["failures"]


@pytest.mark.parametrize("name", SHORT_FORMS)
def test_the_short_form_meets_all_bars_that_it_settles(name):
    _, benchmark = BY_NAME[name]
    code, missed = run(name, *benchmark.short.split())
    assert code == bool(missed)
    assert [
        line for line in missed if not any(each in line for each in benchmark.unsettled)
    ] == []


@pytest.mark.parametrize(("name", "control"), CONTROLS)
def test_a_control_misses_its_bar(name, control):
    _, benchmark = BY_NAME[name]
    taken = benchmark.controls[control]
    short = benchmark.short if taken.short is None else taken.short
    code, missed = run(name, "--control", control, *(short or "").split())
    assert code == 1
    assert any(taken.bar in line for line in missed), missed


def test_every_run_has_arguments_that_its_benchmark_knows():
    from bench import read_runs

    for name, planned in read_runs().items():
        _, *named = planned.what.split()
        if named:
            options = {f"--{option}" for option in BY_NAME[named[0]][1].options}
            words = f"{planned.arguments} {planned.long or ''}".split()
            assert {word for word in words if word.startswith("--")} <= options, name


@pytest.mark.process
@pytest.mark.timeout(700)
def test_each_fold_learns_anew_and_is_judged_in_worlds_that_it_did_not_see(tmp_path):
    pytest.importorskip("tensorboard", reason="needs the extra train")
    from nics_drl_bridge.config import dump_yaml
    from nics_drl_bridge.policy.train.settings import load_training

    shipped = load_training("shipped_jackal")
    given = {"worlds": {"barn": 4, "circles": 2}, "steps": 192, "hidden": (8,)}
    ppo = shipped.ppo.model_copy(update={"batch": 96})
    tiny = shipped.model_copy(update={**given, "ppo": ppo})
    (tmp_path / "tiny.yaml").write_text(dump_yaml(tiny.model_dump(mode="json")))
    words = ("--five-fold", str(tmp_path / "tiny.yaml"), "--every", "45")
    code, missed = run("barn", *words)
    assert code == 1  # it has hardly learnt
    assert not any("a training" in line for line in missed)
