from __future__ import annotations

import numpy as np
import pytest

from identify.drives import drive
from nics_drl_bridge.identify.drive import Drive, TwistIntervals
from nics_drl_bridge.identify.mounting import (
    Mounting,
    jackknifed,
    mounting_without_lateral_motion,
)


def mean_of_twists(_, twists: TwistIntervals) -> Mounting:
    """An estimate whose uncertainty is known: the mean of what is in the twists."""
    first, second, turn = twists.twist.mean(axis=0)
    return Mounting(float(turn), np.array([first, second]), 0.0, np.zeros(2), True)


def test_the_spread_is_the_standard_error_of_a_mean(mecanum):
    driven = Drive(drive(mecanum, duration=40.0), mecanum)
    twists = driven.twists
    rng = np.random.default_rng(0)
    noisy = TwistIntervals(twists.start, twists.end, rng.normal(size=twists.twist.shape))
    expected = 1.0 / np.sqrt(len(noisy.start))
    found = jackknifed(driven, noisy, 0.0, mean_of_twists)
    assert found is not None
    sizes = np.array([found.rotation_sigma, *found.lever_sigma])
    assert (sizes > 0.4 * expected).all()
    assert (sizes < 2.0 * expected).all()


def test_what_lasts_for_a_block_widens_the_uncertainty(mecanum):
    driven = Drive(drive(mecanum, duration=40.0), mecanum)
    twists = driven.twists
    slip = np.repeat(np.random.default_rng(0).normal(size=8), -(-len(twists.start) // 8))
    alike = TwistIntervals(twists.start, twists.end, np.tile(slip[: len(twists.start), None], 3))
    found = jackknifed(driven, alike, 0.0, mean_of_twists)
    assert found is not None
    assert found.rotation_sigma == pytest.approx(slip.std() / np.sqrt(7.0), rel=0.3)


def test_a_drive_that_shows_nothing_has_no_mounting(mecanum):
    driven = Drive(drive(mecanum, duration=20.0), mecanum)
    assert jackknifed(driven, driven.twists, 0.0, lambda *_: None) is None


def test_a_robot_that_keeps_its_heading_and_goes_anywhere_tells_nothing_of_its_mounting():
    course, n = np.linspace(0.0, 6.0, 50), np.arange(50.0)
    twist = np.stack([np.cos(course), np.sin(course), 0.0 * course], axis=1)
    motion = TwistIntervals(n, n + 1.0, twist)
    assert mounting_without_lateral_motion(motion, np.ones(50)) is None
