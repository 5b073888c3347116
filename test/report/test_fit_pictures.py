import re
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import generator
from nics_drl_bridge.identify.hypotheses import Base, Draft
from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.identify.report import collect_estimates, format_report
from nics_drl_bridge.identify.terms import Kind, Library
from nics_drl_bridge.recording.textbook import record
from nics_drl_bridge.report import fit_pictures as pictures
from nics_drl_bridge.report.fit_page import fit_tile, write_fit_page
from nics_drl_bridge.report.fit_pictures import (
    draw_inputs,
    fit_pictures,
    write_pictures,
)
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.robot.taylor import EndErrors

PNG = b"\x89PNG"
slow = pytest.mark.slow


@pytest.fixture(scope="module")
def found():
    spec = load_robot("differential")
    return spec, identify(
        record(spec, np.random.default_rng(0), 30.0), spec, alpha="auto"
    )


@slow
def test_every_picture_of_a_fit_is_drawn(found, tmp_path):
    files = write_pictures(*found, tmp_path / "pictures")
    assert {file.stem for file in files} <= set(generator.PICTURES), (
        "a new model removes them"
    )
    drawn = {file.stem for file in files}
    assert drawn >= {"accuracy", "alignment", "paths", "residuals"}
    assert all(f.read_bytes().startswith(PNG) for f in files)


@slow
def test_a_page_of_a_fit_begins_with_its_verdict_and_folds_all_figures(
    found, blank, tmp_path
):
    spec, identified = found
    text = format_report("here", identified)
    write_fit_page(tmp_path / "report.html", "here", spec, identified, text)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert re.findall("<h2>(.*?)</h2>", html) == ["Verdict", "Paths", "Model"]
    figure, meaning, good = fit_tile(identified)
    assert (
        html.index(figure.replace("<", "&lt;"))
        < html.index(meaning)
        < html.index("Paths")
    )
    assert good
    shown = re.sub("(?s)<details>.*?</details>", "", html)
    assert "Cross-validated error" in html
    assert "Cross-validated error" not in shown
    assert shown.count("<img") == 2  # the paths, and the yardsticks


@slow
def test_a_figure_that_a_yardstick_beats_is_doubtful(found):
    _, identified = found
    at = replace(identified.judgement[3], kept_twist=EndErrors(1e-9, 0.1))
    beaten = replace(identified, findings=replace(identified.findings, judgement=(at,)))
    assert fit_tile(beaten)[2] is False
    untried = replace(identified, findings=replace(identified.findings, judgement=()))
    assert fit_tile(untried)[0] == "untested"


@pytest.fixture
def blank(monkeypatch):
    """Draws figures without making a file of them."""
    monkeypatch.setattr(pictures, "render_png", lambda *_: PNG)


def test_a_short_drive_has_fewer_pictures(found, blank):
    spec, identified = found
    short = replace(identified, unseen=None, held_out=None)
    assert fit_pictures(spec, short).keys() == {"accuracy", "alignment"}


def predicted(identified, kind: Kind):
    """The result of a drive whose terms predictions chose from a kind of library."""
    library = Library(identified.drive.spec, kind, True, "auto", 3)
    draft = Draft(library, form=None, problem=None)
    base = Base(draft, found=None)
    return replace(identified, findings=replace(identified.findings, base=base))


def test_what_pruning_would_have_kept_is_not_told_of_a_motion(found, blank):
    spec, identified = found
    by_motion = predicted(identified, Kind.MOTION)
    text = format_report("here", by_motion)
    kept = identified.model.terms_kept
    for part in ("Eq. 2", "Cross-validated", "linear fit", f"{kept} of"):
        assert part not in text
    assert f"Kept {kept} terms, step" in text
    assert "accuracy" not in fit_pictures(spec, by_motion)


def test_of_what_predictions_chose_only_the_pruning_is_told(found):
    text = format_report("here", predicted(found[1], Kind.FOLLOWER))
    assert "Pruned by Eq. 2 at alpha = 0.99" in text
    assert "Cross-validated" not in text


def test_estimates_are_told_with_their_uncertainty_or_why_there_is_none(found):
    _, identified = found
    text = format_report("here", identified)
    for part in (
        "clock offset: not estimated, pose and commands are on one clock",
        "period of bursts: not estimated, the poses are stamped one by one",
        "wheel scale: not estimated, no wheel speeds were recorded",
    ):
        assert part in text
    sigma = {"clock_offset_s": 0.0104, "lever_arm_x_m": 0.004, "lever_arm_y_m": 0.01}
    calibration = replace(
        identified.calibration,
        clock_offset_s=-3.0012,
        lever_arm_m=(0.1, 0.0),
        burst_period_s=0.1,
        wheels_swapped=True,
        uncertainty=sigma,
    )
    told = collect_estimates(replace(identified, calibration=calibration))
    for name, text in {
        "clock_offset_s": "clock offset -3.001 +- 0.01 s",
        "lever_arm_x_m": "lever arm x 0.1 +- 0.004 m",
        "lever_arm_y_m": "lever arm y 0 +- 0.01 m (below its uncertainty: taken as zero)",
        "burst_period_s": "period of bursts 0.1 s",
        "wheels_swapped": "swapped wheels: left and right are interchanged",
    }.items():
        assert told[name].text == text


def test_motors_are_drawn_and_reported_with_what_is_known_of_them(found):
    spec, identified = found
    assert draw_inputs(spec, identified) is None
    assert "Effect of the motors" not in format_report("drive", identified)
    name = spec.command[0].name
    state = spec.state[0].name
    size = len(spec.state)
    curve = InputCurve(command=name, dead=0.12, least=-0.5, most=0.8, back=0.6)
    friction = np.zeros(size)
    limits = np.tile([-np.inf, np.inf], (size, 1))
    friction[0] = 0.2
    limits[0] = (-3.0, 2.0)
    model = replace(identified.model, inputs=(curve,), friction=friction, limits=limits)
    sigma = {f"{name}.dead": 0.004}
    calibration = replace(identified.calibration, uncertainty=sigma)
    motors = replace(identified, model=model, calibration=calibration)
    report = format_report("drive", motors)
    for part in (
        f"{name}' = 0 within +-0.12, else {name} -+ 0.12",
        ", at least -3, at most 2, less dry friction of 0.2  [rad/s/s]",
        f"{name:<24} dead zone on both sides of 0: 0.12 +- 0.004",
        f"{state:<24} dry friction: 0.2 rad/s/s",
    ):
        assert part in report
    assert draw_inputs(spec, motors).startswith(PNG)
