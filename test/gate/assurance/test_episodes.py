from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.gate.assurance.episodes import Delays, configure_gate, drive
from nics_drl_bridge.gate.assurance.place import Job, Place
from nics_drl_bridge.generator import builtin_model


def test_later_data_never_overtake_earlier_ones_and_are_late_by_at_most_the_maximum():
    delays = Delays(np.random.default_rng(0), 20.0)
    arrivals = np.array([delays.draw_arrival(step) for step in range(200)])
    late = arrivals - np.arange(200)
    assert (np.diff(arrivals) >= 0).all()
    assert late.min() >= 0
    assert 5 < late.max() <= 20


@pytest.mark.parametrize("is_gated", [True, False])
def test_one_that_rams_touches_something_only_without_a_gate(is_gated):
    place = Place(builtin_model("differential"), "arena")
    config = configure_gate(place.model, "differential") if is_gated else None
    decisions = []
    job = Job("ram", 2)
    outcome = drive(place, config, job, lambda *seen: decisions.append(seen))
    assert outcome.contact == (not is_gated)
    assert outcome.latched == ""
    assert outcome.path > 0.2
    published = [decision for decision, _ in decisions if decision.publish]
    assert any(decision.twist.any() for decision in published)
    assert any(decision.shielded for decision in published) == is_gated
    again = drive(place, config, job)
    assert (again.path, again.seconds) == (outcome.path, outcome.seconds)
