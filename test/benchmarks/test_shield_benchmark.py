"""The shield's benchmark in small: over DDS, in process, and with what it measures taken out."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from .runs import CAMPAIGNS, asked, fails

SHORT = ("--in-process", "--episodes", "18")


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_no_adversary_makes_a_shielded_robot_touch_anything():
    code, result = asked("shield.py", *SHORT)
    assert (code, result["failures"]) == (0, [])
    assert (result["episodes"], result["contacts"]) == (18, 0)
    assert {one["episodes"] for one in result["by_world"].values()} == {6}
    assert result["contacts_without"] > result["tried_without"] / 2
    assert result["goals_reached"] > 0


@pytest.mark.campaign
@pytest.mark.ros
@pytest.mark.timeout(600)
def test_over_dds_and_in_real_time_nothing_is_touched():
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    _, result = asked(
        "shield.py",
        "--episodes",
        "6",
        "--place",
        "mecanum/crowd",
        "--place",
        "ackermann/clutter",
        timeout_s=580.0,
    )
    assert (result["driven"], result["contacts"]) == ("over DDS", 0)
    assert result["episodes"] == 6 or result["repeated"] > 0
    assert result["path_m"] > 0.5
    # A busy machine may hold up a heartbeat, or a robot on its way; it may not touch anything.
    busy = ("latched", "goals", "share of the time", "episodes driven")
    assert [line for line in result["failures"] if not line.startswith(busy)] == []


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_without_the_shield_there_are_contacts():
    assert any(
        line.startswith("contacts of")
        for line in fails("shield.py", "no_shield", *SHORT)
    )


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_robots_that_stand_measure_nothing():
    missed = fails("shield.py", "standing", *SHORT)
    assert any(line.startswith("path driven") for line in missed)
    assert any(line.startswith("contacts without") for line in missed)


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_a_shield_that_thinks_the_robot_stops_at_once_touches_something():
    missed = fails("shield.py", "no_braking_distance", *SHORT)
    assert any(line.startswith("contacts of") for line in missed)
    assert any(line.startswith("braking distance") for line in missed)


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    return importlib.import_module


def test_a_car_that_trembles_at_rest_was_walked_into(module):
    places = module("parts.shield_places")
    place = places.Place("ackermann", "crowd")
    place.begin(places.Job("ram", 1, standing=True))
    for _ in range(80):
        place.step(np.zeros(3))
    simulator, (x, y, radius) = place._sim, place.truth.circles[0]
    # People keep out of its way, so it is put where one of them is about to tread.
    still = np.zeros(simulator.data.state.shape[-1])
    simulator.put_robot(0, np.array([x + radius, y, 0.0]), still)
    place._lately.append(np.array([x + radius, y]))
    place._lately.extend(list(place._lately)[-1:] * place._lately.maxlen)
    place.step(np.zeros(3))
    assert place.outcome.walked_into
    assert not place.outcome.contact
    assert place.outcome.path > 0.01  # its noise


def test_a_robot_that_drives_into_something_is_in_contact(module):
    places = module("parts.shield_places")
    place = places.Place("mecanum", "arena")
    place.begin(places.Job("goal", 0))  # which has the time to come to a wall
    while not (place.outcome.contact or place.outcome.walked_into):
        place.step(np.array([0.5, 0.0, 0.0]))
    assert place.outcome.contact
    assert place.outcome.speed == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("share", "met"), [(0.019, True), (0.021, False), (np.nan, False)]
)
def test_a_run_whose_robots_were_held_up_is_none(module, share, met):
    outcome = module("parts.shield_places").Outcome
    shield = module("shield")
    kept_up = {"count": 3, "seconds": 100.0 * share, "of_s": 100.0, "repeated": 2}
    driven = [outcome("ram", path=3.0), outcome("goal", reached=True)]
    bare = [outcome("ram", contact=True), outcome("goal", reached=True)]
    result = shield.summary(driven, bare, (kept_up, {})) | {"braking": 0.9}
    assert (result["held_up"], result["repeated"]) == (3, 2)
    missed = shield.missed(result, 1)
    assert [line.startswith("share of the time") for line in missed] == (
        [] if met else [True]
    )


def test_the_shipped_values_keep_room_to_brake_at_all_speeds(module):
    braking = module("parts.braking")
    assert 0.1 in braking.SHARES
    for robot in ("ackermann", "differential", "mecanum"):
        assert 0.8 < braking.braking_used(robot, {}) <= 1.0
    assert braking.braking_used("ackermann", {"latency": 0.17}) > 1.0
