"""Every campaign meets its bars in its short form, and misses the named one under each control."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
from importlib.util import find_spec

import pytest

from .campaign import CAMPAIGNS, FOLDER, NAV2_SOURCES, ROOT, Campaign

UNMET = {
    "root": os.geteuid() != 0 or None in map(shutil.which, ("ip", "nft")),
    "nav2": not NAV2_SOURCES.is_file(),
}
MARGIN_S = 60.0


def marks_of(campaign: Campaign, quick: bool) -> list[pytest.MarkDecorator]:
    """What a test of a campaign needs, and its ring."""
    lacking = [
        need
        for need in campaign.needs
        if UNMET.get(need, need not in UNMET and find_spec(need) is None)
    ]
    marks = [
        pytest.mark.process,
        pytest.mark.timeout(campaign.attempts * campaign.timeout_s + MARGIN_S),
        pytest.mark.skipif(bool(lacking), reason=f"needs {', '.join(lacking)}"),
        pytest.mark.slow if quick else pytest.mark.campaign,
    ]
    return [*marks, pytest.mark.ros] if "rclpy" in campaign.needs else marks


SHORT_FORMS = [
    pytest.param(name, marks=marks_of(campaign, campaign.quick))
    for name, campaign in CAMPAIGNS.items()
]
CONTROLS = [
    pytest.param(name, control, marks=marks_of(campaign, quick=False))
    for name, campaign in CAMPAIGNS.items()
    for control in campaign.controls
]


def run(name: str, *arguments: str) -> tuple[int, list[str]]:
    """The exit code of a campaign, and the bars that it says it missed."""
    campaign = CAMPAIGNS[name]
    script = FOLDER / f"{campaign.script or name}.py"
    done = subprocess.run(
        [sys.executable, str(script), "--json", *arguments],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=campaign.timeout_s,
    )
    assert done.stdout.count("\n") == 1, done.stdout + done.stderr
    return done.returncode, json.loads(done.stdout)["failures"]


def run_here(name: str, capsys, monkeypatch) -> tuple[int, list[str]]:
    """The same of a quick short form, in this process, which has loaded most of it."""
    script = str(FOLDER / f"{name}.py")
    words = CAMPAIGNS[name].short.split()
    monkeypatch.setattr(sys, "argv", [script, "--json", *words])
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(script, run_name="__main__")
    return ended.value.code, json.loads(capsys.readouterr().out)["failures"]


@pytest.mark.parametrize("name", SHORT_FORMS)
def test_the_short_form_meets_all_bars(name, capsys, monkeypatch):
    campaign = CAMPAIGNS[name]
    if campaign.quick:
        assert run_here(name, capsys, monkeypatch) == (0, [])
        return
    for _ in range(campaign.attempts):
        code, missed = run(name, *campaign.short.split())
        if code == 0:
            break
    assert (code, missed) == (0, [])


@pytest.mark.parametrize(("name", "control"), CONTROLS)
def test_a_control_misses_its_bar(name, control):
    campaign = CAMPAIGNS[name]
    taken = campaign.controls[control]
    short = campaign.short if taken.short is None else taken.short
    code, missed = run(name, "--control", control, *short.split())
    assert code == 1
    assert any(taken.bar in line for line in missed), missed


@pytest.mark.parametrize(
    "name", [pytest.param("transfer", marks=marks_of(CAMPAIGNS["transfer"], False))]
)
def test_a_killed_run_goes_on_to_the_same_result(name, tmp_path):
    script = str(FOLDER / f"{name}.py")
    words = [sys.executable, script, "--json", *CAMPAIGNS[name].short.split(), "--out"]
    whole = subprocess.run([*words, tmp_path / "whole"], capture_output=True)
    killed = tmp_path / "killed"
    with subprocess.Popen(
        [*words, killed], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        next(line for line in process.stderr if line.startswith("1 of 3"))
        os.killpg(process.pid, signal.SIGKILL)
    rest = subprocess.run([*words, killed], capture_output=True, text=True)
    assert "of 3" not in rest.stderr
    assert rest.stdout == whole.stdout.decode() != ""


def test_every_script_is_in_the_registry():
    scripts = {
        path.stem
        for path in FOLDER.glob("*.py")
        if "from campaign import" in path.read_text() and "test_" not in path.stem
    }
    assert scripts == {campaign.script or name for name, campaign in CAMPAIGNS.items()}
