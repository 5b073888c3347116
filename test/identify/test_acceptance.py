from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify import planted
from identify.drives import fit_trial
from nics_drl_bridge import geometry
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.judgement import (
    Outcome,
    Verdict,
    combine_ratings,
    compare,
    describe_shortfall,
    estimate_comparison_noise,
    is_beaten_by_textbook,
    list_doubts_of_commands,
    loses_to_textbook,
    rate,
    rate_unseen,
)
from nics_drl_bridge.identify.report import format_with_error
from nics_drl_bridge.robot.taylor import EndErrors, HorizonErrors

RADIUS_M = 0.2


def errors(position: float) -> EndErrors:
    return EndErrors(position, 0.01)


def after_5_s(
    position: float,
    path: float = 10.0,
    textbook: float | None = None,
    twist: float = 8.0,
    coverage: float | None = 0.95,
    noise: float = 0.0,
    standing: float | None = None,
) -> tuple[HorizonErrors, ...]:
    """Returns the judgement of a model of which one horizon is known."""
    at = HorizonErrors(
        horizon_s=5.0,
        windows=100,
        path_m=path,
        model=errors(position),
        kept_twist=errors(twist),
        textbook=None if textbook is None else errors(textbook),
        band_m=1.0,
        coverage=coverage,
        kept_twist_noise_m=noise,
        textbook_noise_m=noise,
        standing=None if standing is None else errors(standing),
        standing_noise_m=noise,
    )
    return (at,)


RATED = {
    Verdict.GOOD: [
        after_5_s(0.2),
        after_5_s(1.0),
        after_5_s(0.2, coverage=0.80),
        after_5_s(0.2, coverage=None),
        after_5_s(0.9, textbook=0.5, noise=0.5),
        after_5_s(0.01, path=0.0),
        after_5_s(0.9, standing=1.0),
        after_5_s(0.01, path=0.0, standing=0.0),  # it stood still
    ],
    Verdict.WITH_CARE: [
        after_5_s(1.01),
        after_5_s(2.5),
        after_5_s(0.2, coverage=0.79),
        after_5_s(0.9, twist=1.0, noise=0.5),
    ],
    Verdict.DO_NOT_TRAIN: [
        after_5_s(2.51),
        after_5_s(np.inf),
        after_5_s(np.nan),
        after_5_s(0.2, coverage=0.49),
        after_5_s(0.9, twist=0.5),
        after_5_s(0.9, textbook=0.5),
        after_5_s(0.1, path=0.0),  # half of the robot, on the spot
        after_5_s(0.9, standing=1.0, noise=0.2),
        after_5_s(0.9, standing=0.8),
        (),
    ],
}


@pytest.mark.parametrize(
    ("judgement", "verdict"),
    [(each, key) for key, row in RATED.items() for each in row],
)
def test_the_verdict_is_one_of_three_words_by_stated_thresholds(judgement, verdict):
    found = rate(judgement, RADIUS_M, textbook=False)
    assert found.verdict is verdict
    assert bool(found.reasons) == (verdict is not Verdict.GOOD and bool(judgement))


def test_a_reason_names_the_figure_and_its_limit():
    error, band = rate(after_5_s(2.04, coverage=0.6), RADIUS_M, textbook=False).reasons
    assert "20.4% of their path" in error
    assert "within 10%" in error
    assert "holds 60%" in band
    assert "less than 80%" in band


def test_much_time_without_a_pose_is_a_reason_for_care():
    assert rate_unseen(1.0, 100.0).verdict is Verdict.GOOD
    unseen = rate_unseen(27.8, 200.0)
    assert unseen.verdict is Verdict.WITH_CARE
    assert "missing for 27.8 s, 14% of the drive" in unseen.reasons[0]


def test_the_least_favourable_verdict_counts():
    ratings = [
        rate_unseen(0.0, 100.0),
        rate(after_5_s(3.0), RADIUS_M, False),
        rate_unseen(9.0, 10),
    ]
    both = combine_ratings(ratings)
    assert both.verdict is Verdict.DO_NOT_TRAIN
    assert len(both.reasons) == 2


def test_a_tie_is_neither_better_nor_worse():
    assert compare(errors(0.1005), errors(0.1), 0.0, 2.0) is Outcome.ALIKE  # 0.5 mm
    assert compare(errors(0.2), errors(0.1), 0.15, 2.0) is Outcome.ALIKE
    assert compare(errors(0.2), errors(0.1), 0.05, 2.0) is Outcome.WORSE
    assert compare(errors(0.1), errors(0.2), 0.05, 2.0) is Outcome.BETTER
    assert compare(errors(float("inf")), errors(0.2), 0.05, 2.0) is Outcome.WORSE


@pytest.mark.parametrize(
    ("error_m", "beaten"),
    [(0.09, False), (0.106, False), (0.108, True), (float("inf"), True)],
)
def test_the_fitted_textbook_beats_a_model_that_is_farther_off(error_m, beaten):
    assert is_beaten_by_textbook(after_5_s(error_m, path=2.0, textbook=0.1)) == beaten
    assert not is_beaten_by_textbook(after_5_s(error_m, path=2.0))


def test_a_tie_with_the_textbook_is_no_shortfall():
    tie = after_5_s(0.1005, path=2.0, textbook=0.1)
    assert not loses_to_textbook(tie)
    assert list(describe_shortfall(tie)) == []
    assert rate(tie, RADIUS_M, textbook=False).verdict is Verdict.GOOD


def test_the_noise_of_a_comparison_is_that_of_stretches_and_not_of_windows():
    """Windows of one stretch are copies of each other: ten times as many tell no more."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=20)
    few = estimate_comparison_noise(
        np.repeat(means, 5), np.repeat(5.0 * np.arange(20), 5), 5.0
    )
    many = estimate_comparison_noise(
        np.repeat(means, 50), np.repeat(5.0 * np.arange(20), 50), 5.0
    )
    assert few == pytest.approx(many)
    assert few == pytest.approx(means.std(ddof=1) / np.sqrt(20.0), rel=0.3)


def test_in_one_stretch_the_noise_is_that_of_a_single_window():
    difference = np.array([0.1, 0.3, 0.2, 0.4])
    noise = estimate_comparison_noise(difference, np.linspace(0.0, 1.0, 4), 5.0)
    assert noise == pytest.approx(difference.std())


@pytest.mark.slow
def test_a_pose_that_has_nothing_to_do_with_the_commands_is_not_trained_on():
    """Noise makes a long path, of which the error is a small share."""
    rng = np.random.default_rng(3)
    spec = planted.wheeled().model_copy(update={"state": ()})
    made = planted.wheeled_drive()
    walk = np.cumsum(rng.normal(0.0, 0.02, made.pose.values.shape), axis=0)
    walk[:, 2] = geometry.wrap_angle(walk[:, 2])
    strayed = replace(made.pose, values=walk)
    found = fit_trial(replace(made, pose=strayed, state=None), spec)
    assert found.verdict is Verdict.DO_NOT_TRAIN
    assert any(
        "a robot that never moves" in reason for reason in found.assessment.reasons
    )


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (4.63, 0.02, "(4.63 +- 0.02)"),
        (0.312, 36.0, "(0.312 +- 36)"),
        (1.6, 1.6, "(1.6 +- 1.6)"),
        (0.00123, 0.5, "(0.00123 +- 0.5)"),
        (1234.0, 500.0, "(1234 +- 500)"),
        (123.4, 17.0, "(123 +- 17)"),
        (0.025, 9.7e-5, "(0.025000 +- 0.000097)"),
        (5.0, 1e-9, "5"),
        (5.0, None, "5"),
    ],
)
def test_a_number_has_the_digits_that_its_error_leaves(value, error, text):
    assert format_with_error(value, error) == text


def doubts(error: float, without: float = 1.0, latency: float = 0.1) -> list[str]:
    ends = EndErrors(error, 0.1), EndErrors(without, 0.1)
    judgement = (HorizonErrors(5.0, 9, 2.0, *ends),)
    return list(
        list_doubts_of_commands(
            judgement, replace(Calibration(), command_latency_s=latency)
        )
    )


def test_commands_that_hardly_help_are_said():
    (doubt,) = doubts(0.9)
    assert doubt.startswith(
        "The commands hardly help: predictions by them end 0.9 m off after 5 s"
    )


@pytest.mark.parametrize("latency", [1.4, -0.5])
def test_an_implausible_latency_is_said(latency):
    (doubt,) = doubts(0.1, latency=latency)
    assert f"A latency of {latency:.2f} s" in doubt


def test_commands_that_help_at_once_raise_no_doubt():
    assert doubts(0.3) == []
