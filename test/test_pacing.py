import numpy as np
import pytest

from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.pacing import (
    ActionPace,
    Answer,
    Deadline,
    RealTime,
    TopicPace,
    find_common_step,
)


def test_jitter_of_the_data_does_not_slow_it_down():
    rng = np.random.default_rng(0)
    polled = np.arange(0.0, 20.0, 0.01)
    arrivals = 0.1 * np.arange(200) + rng.uniform(0.0, 0.03, 200)
    pace = ActionPace(0.1)
    done = 0
    used = -1
    for now in polled:
        newest = int(np.searchsorted(arrivals, now, side="right")) - 1
        if newest > used and not pace.get_wait(now):
            pace.acted(now)
            done = done + 1
            used = newest
    assert done >= 190


@pytest.mark.parametrize(
    ("period", "times", "acted"),
    [
        (0.1, [0.0, 0.35, 0.36, 0.4, 0.45, 0.5], [0.0, 0.35, 0.45]),
        (0.0, [0.0, 0.001, 0.002], [0.0, 0.001, 0.002]),
    ],
    ids=["late data are not made up for", "no period"],
)
def test_data_are_acted_on_once_a_period_has_passed(period, times, acted):
    pace = ActionPace(period)
    done = []
    for now in times:
        if not pace.get_wait(now):
            pace.acted(now)
            done.append(now)
    assert done == acted


def test_what_comes_early_waits_until_it_is_due():
    pace = ActionPace(0.1)
    pace.acted(1.0)
    assert pace.get_wait(1.07) == pytest.approx(0.03)
    assert pace.get_wait(1.1) == 0.0


def test_a_late_answer_is_dropped_and_several_in_a_row_stop_the_robot():
    deadline = Deadline(0.05, 3)
    times = [0.01, 0.06, 0.06, 0.06, 0.07, 0.02, 0.06]
    assert [deadline.judge(taken) for taken in times] == [
        Answer.SEND,
        Answer.DROP,
        Answer.DROP,
        Answer.STOP,
        Answer.STOP,
        Answer.SEND,
        Answer.DROP,
    ]
    assert (deadline.answered, deadline.late, deadline.longest_s) == (2, 5, 0.07)


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


def test_steps_that_were_missed_are_made_up_for_unless_they_are_many():
    clock = RealTime(STEP, 1.0)
    clock.begin(1000, 500)
    assert clock.behind(1000 + 3 * STEP, 500) == 3
    assert clock.behind(1000 + 3 * STEP, 500 + 3 * STEP) == 0
    assert not clock.lost(1000 + 3 * STEP, 500)
    assert clock.lost(1000 + NS_PER_S, 500)


def test_time_runs_as_many_times_faster_as_the_rate_says():
    clock = RealTime(STEP, 4.0)
    clock.begin(0, 0)
    assert clock.behind(STEP, 0) == 4
    assert clock.time_at(NS_PER_S) == 4 * NS_PER_S
