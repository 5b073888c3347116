from __future__ import annotations

import pytest

from nics_drl_bridge.middleware.timeline import CLOCK_JUMP, FUTURE_NS, Stamps

SECOND = 1_000_000_000


def heard(stamp=100 * SECOND, arrival=7 * SECOND, **options):
    stamps = Stamps(**options)
    assert stamps.fault(stamp, arrival) == ""
    stamps.accept(stamp, arrival)
    return stamps


@pytest.mark.parametrize("offset", [-(10**18), 0, 10**18])
def test_the_first_stamp_shows_how_the_clocks_lie(offset):
    stamps = heard(100 * SECOND + offset)
    assert stamps.fault(101 * SECOND + offset, 8 * SECOND) == ""
    assert "in the future" in stamps.fault(109 * SECOND + offset, 8 * SECOND)


@pytest.mark.parametrize("elapsed", [0, 1, SECOND, 60 * SECOND])
def test_a_stamp_may_be_ahead_of_what_is_due_by_the_tolerance(elapsed):
    stamps, due = heard(), 100 * SECOND + elapsed + FUTURE_NS
    assert stamps.fault(due, 7 * SECOND + elapsed) == ""
    assert stamps.fault(due + 1, 7 * SECOND + elapsed) == "more than 1 s in the future"


def test_a_receivers_clock_that_is_set_back_makes_nothing_come_from_the_future():
    assert heard().fault(100 * SECOND + FUTURE_NS, 0) == ""


def test_a_simulation_with_long_periods_may_outrun_the_receivers_clock():
    stamps = heard(period_ns=3 * SECOND)
    assert stamps.fault(103 * SECOND, 7 * SECOND) == ""
    assert stamps.fault(107 * SECOND, 7 * SECOND) == "more than 6 s in the future"


def test_old_stamps_do_not_change_what_is_due():
    stamps = heard()
    stamps.accept(50 * SECOND, 9 * SECOND)
    assert stamps.fault(102 * SECOND, 7 * SECOND) != ""


def test_a_row_of_refusals_means_that_the_clock_was_set():
    stamps = heard()
    assert [stamps.refuse() for _ in range(CLOCK_JUMP)] == [False] * (CLOCK_JUMP - 1) + [True]


def test_one_datum_that_is_used_ends_the_row():
    stamps = heard()
    for _ in range(CLOCK_JUMP - 1):
        assert not stamps.refuse()
    stamps.accept(101 * SECOND, 8 * SECOND)
    assert not stamps.refuse()
