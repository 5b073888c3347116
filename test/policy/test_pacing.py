from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.policy.pacing import ActionPace, Answer, Deadline


def actions(pace, times):
    done = []
    for now in times:
        if not pace.get_wait(now):
            pace.acted(now)
            done.append(now)
    return done


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


def test_late_data_are_acted_on_at_once_and_not_made_up_for():
    assert actions(ActionPace(0.1), [0.0, 0.35, 0.36, 0.4, 0.45, 0.5]) == [
        0.0,
        0.35,
        0.45,
    ]


def test_what_comes_early_waits_until_it_is_due():
    pace = ActionPace(0.1)
    pace.acted(1.0)
    assert pace.get_wait(1.07) == pytest.approx(0.03)
    assert pace.get_wait(1.1) == 0.0


def test_without_a_period_everything_is_acted_on():
    assert actions(ActionPace(0.0), [0.0, 0.001, 0.002]) == [0.0, 0.001, 0.002]


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
