import pytest

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.sim.pacing import (
    RealTime,
    TopicPace,
    find_common_step,
)

STEP = NS_PER_S // 50


def due(pace, seconds, step=STEP):
    return [now for now in range(0, seconds * NS_PER_S, step) if pace.due(now)]


def test_where_the_step_divides_the_period_messages_are_regular():
    assert due(TopicPace(NS_PER_S // 10, STEP), 1) == list(
        range(0, NS_PER_S, NS_PER_S // 10)
    )


def test_where_it_does_not_the_mean_rate_is_still_the_asked_one():
    times = due(TopicPace(round(NS_PER_S / 5.5), STEP), 20)
    assert len(times) == 110
    assert all(abs(now - k * NS_PER_S / 5.5) <= STEP / 2 for k, now in enumerate(times))


def test_after_a_reset_a_message_is_due_at_once():
    pace = TopicPace(NS_PER_S, STEP)
    assert pace.due(0)
    assert not pace.due(STEP)
    pace.begin(2 * STEP)
    assert pace.due(2 * STEP)


@pytest.mark.parametrize(
    ("periods", "steps"),
    [((0.1, 0.02), 2), ((0.1, 0.1), 10), ((0.025, 0.02), 2), ((0.001,), 1)],
)
def test_the_world_moves_by_the_longest_step_that_meets_all_periods(periods, steps):
    assert find_common_step(0.01, periods) == steps


def test_steps_that_were_missed_are_made_up_for():
    clock = RealTime(STEP, 1.0)
    clock.begin(1000, 500)
    assert clock.behind(1000 + 3 * STEP, 500) == 3
    assert clock.behind(1000 + 3 * STEP, 500 + 3 * STEP) == 0
    assert not clock.lost(1000 + 3 * STEP, 500)


def test_time_runs_as_many_times_faster_as_the_rate_says():
    clock = RealTime(STEP, 4.0)
    clock.begin(0, 0)
    assert clock.behind(STEP, 0) == 4
    assert clock.time_at(NS_PER_S) == 4 * NS_PER_S


def test_a_world_that_is_seconds_behind_is_lost():
    clock = RealTime(STEP, 1.0)
    clock.begin(0, 0)
    assert clock.lost(NS_PER_S, 0)
