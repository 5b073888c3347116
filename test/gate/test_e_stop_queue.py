"""Whether a press of the e-stop may have been lost while the gate slept."""

import pytest

from nics_drl_bridge.gate.e_stop_queue import (
    LONGEST_SLEEP_S,
    QUEUE_MESSAGES,
    EStopQueue,
)


def heard_at(rate, seconds=2.0):
    """A queue that has heard messages at a rate, up to a last tick at the time 0."""
    queue = EStopQueue()
    for k in range(round(rate * seconds), -1, -1):
        queue.add(-k / rate, 1)
        assert queue.tick(-k / rate) == ""
    return queue


@pytest.mark.parametrize("rate", [5.0, 100.0, 1000.0])
def test_a_sleep_in_which_not_all_messages_fit_counts_as_a_press(rate):
    fits = min(QUEUE_MESSAGES / rate, LONGEST_SLEEP_S)
    assert heard_at(rate).tick(0.9 * fits) == ""
    assert "the gate slept for" in heard_at(rate).tick(1.1 * fits)
    assert heard_at(5.0).tick(LONGEST_SLEEP_S) == ""


def test_more_messages_at_once_than_surely_fit_count_as_a_press():
    """A second publisher at 1 kHz began in a short sleep, of whose rate nothing is known yet."""
    queue = heard_at(100.0)
    queue.add(0.4, 250)
    assert "250 messages came at once" in queue.tick(0.4)
    queue.add(0.42, QUEUE_MESSAGES)
    assert queue.tick(0.42) == ""


@pytest.mark.parametrize("heard", [True, False])
def test_without_a_button_or_before_the_first_tick_no_sleep_loses_a_press(heard):
    queue = EStopQueue()
    if heard:
        queue.add(0.0, 1)
    else:
        queue.tick(0.0)
    assert queue.tick(100.0) == ""
