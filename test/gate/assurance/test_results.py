from __future__ import annotations

from nics_drl_bridge.gate.assurance.protocol import LIMITS, STOPS, TOUCHES
from nics_drl_bridge.gate.assurance.results import (
    find_clusters,
    summarise,
)

from .samples import fault, row


def test_failures_of_one_kind_at_one_place_are_one_cluster_with_all_its_seeds():
    touched = [row(seed, contact=True) for seed in (3, 4)]
    elsewhere = row(5, contact=True, position=[4.0, 0.0])
    twice = row(6, kind="jerk", contact=True, violations={"rate": 2})
    clusters = find_clusters([row(1), *touched, elsewhere, twice])
    assert [cluster["seeds"] for cluster in clusters] == [[3, 4], [6], [6], [5]]
    assert clusters[0] == {
        "claim": TOUCHES,
        "kind": "ram",
        "world": "arena",
        "near": (0.0, -4.0),
        "failures": 2,
        "seeds": [3, 4],
    }
    assert {cluster["claim"] for cluster in clusters[1:3]} == {LIMITS, TOUCHES}


def test_a_control_counts_for_itself_and_a_claim_without_trials_is_not_tested():
    rows = [row(1), row(1, gated=False, contact=True), row(2, walked_into=True)]
    results = summarise(rows, faults=0)
    assert results["claims"][TOUCHES]["failures"] == 0
    assert results["claims"][TOUCHES]["trials"] == results["episodes"] == 2
    assert results["control"][TOUCHES]["failures"] == 1
    assert results["claims"][TOUCHES]["one_sided"]
    assert not results["control"][TOUCHES]["one_sided"]
    assert results["claims"][STOPS]["trials"] == 0
    assert results["failures"] == []
    assert results["walked_into"] == 1


def test_in_a_run_that_is_a_control_its_failures_are_kept():
    results = summarise(
        [row(1, gated=False, contact=True), row(2, gated=False)], faults=0
    )
    assert [failed["seed"] for failed in results["failures"]] == [1]


def test_a_fault_counts_for_stopping_and_those_without_a_row_were_not_injected():
    late = fault(8, in_time=False)
    results = summarise([row(1), fault(7), late], faults=3)
    assert results["claims"][STOPS]["trials"] == 2
    assert results["claims"][STOPS]["failures"] == 1
    assert results["claims"][TOUCHES]["trials"] == 1
    assert results["not_injected"] == 1
    assert results["failures"] == [late]
    assert results["clusters"][0]["kind"] == "nan_scan"
