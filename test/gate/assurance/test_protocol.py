from __future__ import annotations

from dataclasses import replace

import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate.assurance.protocol import (
    CLAIMS,
    KINDS,
    LIMITS,
    NO_GATE,
    choose_claims,
)
from nics_drl_bridge.robot.spec import load_robot

from .samples import FAULTS, PROTOCOL


def test_every_episode_has_a_seed_of_its_own_known_in_advance():
    seeds = [trial.seed for trial in PROTOCOL.list_trials() if trial.gated]
    assert seeds == list(range(7, 1507))
    assert list(PROTOCOL.list_trials()) == list(replace(PROTOCOL).list_trials())


@pytest.mark.parametrize("episodes", [10, 1500])
def test_each_driver_in_each_world_is_tried_with_and_without_the_gate(episodes):
    trials = list(replace(PROTOCOL, episodes=episodes).list_trials())
    for gated in (True, False):
        tried = {(t.kind, t.world) for t in trials if t.gated == gated}
        assert tried == {(kind, world) for kind in KINDS for world in PROTOCOL.worlds}
    controls = sum(not trial.gated for trial in trials)
    assert controls <= 10 + episodes // 47 + 1


def test_a_control_drives_the_same_episodes_without_the_gate():
    control = replace(PROTOCOL, control=NO_GATE)
    expected = [
        trial._replace(gated=False) for trial in PROTOCOL.list_trials() if trial.gated
    ]
    assert list(control.list_trials()) == expected


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"policy": "mine.onnx"}, "'policy'"),
        ({"seed": 8}, "'seed'"),
        ({"episodes": 1501}, "'episodes'"),
        ({"control": NO_GATE}, "'control'"),
        ({"worlds": ("arena",)}, "'worlds'"),
        ({"hashes": {"policy file": "2"}}, "'hashes.policy file'"),
        ({"versions": {"numpy": "2", "numba": "1"}}, "'versions.numba'"),
    ],
)
def test_another_protocol_has_another_hash_and_is_refused_by_its_difference(
    change, name
):
    other = replace(PROTOCOL, **change)
    assert other.sha256 != PROTOCOL.sha256
    with pytest.raises(ConfigError, match=name):
        other.check_same(PROTOCOL.data, "runs/assure")
    PROTOCOL.check_same(PROTOCOL.data, "runs/assure")


def test_of_a_car_by_turn_rate_only_values_are_claimed():
    car = load_robot("ackermann")
    assert choose_claims(car) == CLAIMS
    by_turn_rate = car.model_copy(update={"angular_is": "turn_rate"})
    assert "rate" in CLAIMS[LIMITS]
    assert "rate" not in choose_claims(by_turn_rate)[LIMITS]


def test_only_a_seed_of_the_run_is_found():
    assert PROTOCOL.find_trial(9).seed == 9
    with pytest.raises(ConfigError, match="--replay 6: the run has the seeds 7 to"):
        PROTOCOL.find_trial(6)


def test_injections_are_sorted_by_fault_and_have_seeds_after_those_of_the_episodes():
    trials = FAULTS.list_faults()
    assert [trial.kind for trial in trials if trial.gated] == list("aaabbcc")
    assert [trial.kind for trial in trials if not trial.gated] == ["a", "b"]
    assert [trial.seed for trial in trials] == list(range(1507, 1516))
    assert FAULTS.find_trial(1510) == trials[3]
    assert PROTOCOL.list_faults() == []


def test_in_a_control_only_faults_that_nothing_else_answers_are_injected():
    trials = replace(FAULTS, control=NO_GATE).list_faults()
    assert [trial.kind for trial in trials] == list("aaaabbb")
    assert not any(trial.gated for trial in trials)
