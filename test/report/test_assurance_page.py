import re
from dataclasses import replace
from html import unescape

from gate.assurance.samples import FAULTS, PROTOCOL, fault, row

from nics_drl_bridge.gate.assurance.protocol import (
    CLAIMS,
    CLAIMS_BY_TURN_RATE,
    LIMITS,
    NO_GATE,
)
from nics_drl_bridge.gate.assurance.results import summarise
from nics_drl_bridge.report.assurance_page import make_assurance_page


def read(rows, protocol=PROTOCOL):
    """The text of the page of some rows."""
    results = summarise(rows, len(protocol.list_faults()))
    page = make_assurance_page(protocol, results, "runs/mine")
    return unescape(re.sub("<[^>]+>", " ", page.partition("</style>")[2]))


CONTROL = row(1, gated=False, contact=True)


def test_without_failures_the_page_tells_the_bound_and_that_a_failure_can_be_found():
    text = read([row(1), row(2), CONTROL])
    assert "one-sided, a rate below about 3/n, here 7.8e-01 for 2 trials" in text
    assert "Control, touches nothing: without the gate, 1 of 1 trials fail" in text
    assert (
        "zero failures with it prove nothing" in text
    )  # of the limits, which the control kept
    assert "stopping in time was not tested" in text
    assert PROTOCOL.sha256 in text
    assert re.search(r"ram: drives into .* 0 of 2\s+1 of 1", text)


def test_a_failure_is_told_with_the_command_that_replays_it():
    text = read([row(1), row(9, contact=True), CONTROL])
    assert "Failed trials: 1. Clusters: 1." in text
    assert "nics assure differential --limits differential" in text
    assert "--out runs/mine --replay 9" in text


def test_faults_are_listed_with_those_that_could_not_be_injected():
    text = read([row(1), fault(7)], FAULTS)
    assert "1 faults were injected over DDS" in text
    assert "of the policy: a, b, c." in text
    assert "8 faults could not be injected" in text
    assert "⚠ 0 of 1" in text
    assert "was not tested" not in text
    assert "9 faults could not be injected" in read([row(1)], FAULTS)


def test_only_kinds_of_fault_that_were_tried_are_listed():
    text = read([row(1), fault(7)], replace(FAULTS, faults=2))
    assert "of the policy: a, b." in text


def test_the_page_claims_what_the_protocol_claims():
    claims = CLAIMS_BY_TURN_RATE
    text = read([row(1), CONTROL], replace(PROTOCOL, claims=claims))
    assert text.count(claims[LIMITS]) >= 2
    assert CLAIMS[LIMITS] not in text


def test_in_a_control_failures_are_what_is_wanted():
    text = read([CONTROL], replace(PROTOCOL, control=NO_GATE))
    assert "the gate was off" in text
    assert "1 of 1" in text
    assert "⚠ 0 of 1" in text  # the limits, of which none failed
