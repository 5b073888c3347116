from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gate.rig import TICK_S, Rig, config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import black_box
from nics_drl_bridge.gate.black_box import (
    FORMAT,
    Entry,
    from_plain,
    replay,
    write,
)
from nics_drl_bridge.gate.state import ShieldConfig
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.robot.braking import Drift, TurnBraking


class Recorded(Rig):
    """A rig whose black box sees all."""

    def __init__(self, given):
        super().__init__(given)
        self.entries = []

    def give(self, event, now=None):
        before = self.state
        decision = super().give(event, now)
        now = self.now if now is None else now
        self.entries.append(Entry(now, event, before, decision))
        return decision


SHIELD = ShieldConfig(0.2, 1.0, 0.05, 0.02, 0.15, 0.2, obstacle_speed=0.0)
SHIELDS = (
    SHIELD,
    replace(SHIELD, lever=0.2, order=np.inf, drift=Drift(0.9, 2.0, 1.1)),
    replace(SHIELD, wheelbase=0.0, turn=TurnBraking(0.4, 3.0, 0.6, 0.5)),
)


@cache
def drive_to_stop(shield):
    rig = Recorded(config(shield=shield)).drive()
    rig.command([np.nan, 1.0, -0.0])
    rig.run(0.3)
    rig.now += TICK_S
    rig.scan(stamp_ns=rig.stamp + 5 * NS_PER_S)
    return rig


def stopped(path, shield=SHIELD):
    rig = drive_to_stop(shield)
    write(rig.config, tuple(rig.entries), path)
    return rig


@pytest.mark.parametrize("shield", SHIELDS)
def test_a_stop_replays_to_the_same_decisions_bit_for_bit(tmp_path, shield):
    rig = stopped(tmp_path / "stop.jsonl", shield=shield)
    again = replay(tmp_path / "stop.jsonl")
    assert again.differing == ()
    assert len(again.entries) == len(rig.entries)
    assert again.entries[-1].decision.cause.rule == "stamps_jumped"
    for held, read in zip(rig.entries, again.entries, strict=True):
        assert held.decision.twist.tobytes() == read.decision.twist.tobytes()
        assert (held.now, type(held.given)) == (read.now, type(read.given))


def test_a_fault_that_latched_behind_a_fault_of_the_clock_is_replayed(tmp_path):
    rig = Recorded(config()).drive()
    rig.now += 0.25  # the gate was asleep
    rig.tick()
    rig.scan(stamp_ns=rig.stamp + 5 * NS_PER_S)
    rig.run(0.5)
    write(rig.config, tuple(rig.entries), tmp_path / "stop.jsonl")
    again = replay(tmp_path / "stop.jsonl")
    assert again.differing == ()
    told = [line.partition("stopped by ")[2] for line in again.story[-3:-1]]
    assert told[0].startswith("own_clock: ")
    assert told[1].startswith("stamps_jumped: topic=scan")


def test_the_story_of_a_replay_names_each_stop_and_when_it_was(tmp_path):
    stopped(tmp_path / "stop.jsonl")
    story = replay(tmp_path / "stop.jsonl").story
    assert "stopped by disarmed" in story[0]
    assert story[-2].startswith("  +0.000 s  stopped by stamps_jumped: topic=scan")
    assert any(
        "stopped by command_malformed: topic=cmd_vel_raw" in line for line in story
    )
    assert story[-1].endswith("all decided the same again")


def rewrite(path, change):
    """Changes the records of a black box; its checksum is right."""
    head, *lines = [json.loads(line) for line in path.read_text().splitlines()[:-1]]
    change(head, lines)
    text = "".join(json.dumps(line) + "\n" for line in (head, *lines))
    seal = {"sha256": hashlib.sha256(text.encode()).hexdigest()}
    path.write_text(f"{text}{json.dumps(seal)}\n")


def test_another_decision_than_the_recorded_one_is_found(tmp_path):
    path = tmp_path / "stop.jsonl"
    count = len(stopped(path).entries)
    rewrite(path, lambda _, lines: lines[-1]["decision"].update(granted=True))
    assert replay(path).differing == (count - 1,)


def test_every_flipped_bit_is_refused(tmp_path):
    path = tmp_path / "stop.jsonl"
    stopped(path)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(40):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"stop\.jsonl"):
            replay(path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is not a black box"),
        ("{}", "is not a black box"),
        ("{", "is not JSON"),
        (f'{{"format": "{FORMAT}"}}', "is damaged"),
        (f'{{"format": "{FORMAT}", "config": {{"kind": "Spy"}}}}', "is damaged"),
        ("[" * 3_000_000, "contains 3000000 values"),
        ("[" * 5000, "not JSON"),
    ],
    ids=lambda value: value[:20],
)
def test_a_file_that_is_no_black_box_is_one_sentence(tmp_path, text, sentence):
    path = tmp_path / "stop.jsonl"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=sentence):
        replay(path)


def huge(**changes):
    return {"kind": "array", "type": "<f8", "shape": [10**15], "data": ""} | changes


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"given": huge()},
        {"given": huge(type="|O", shape=[1], data="AAAAAAAAAAA=")},
        {"given": huge(type=f"<U{2**29}")},
        {"given": {"kind": "Limits"}},
        {"given": 3},
        {"given": None},
        {"now": "x"},
        {"now": None},
        {"now": 1e12},
        {"decision": {"kind": "EStop", "pressed": True}},
        {"decision": []},
        None,
    ],
    ids=str,
)
def test_a_record_that_is_none_of_the_gate_is_one_sentence(tmp_path, change):
    path = tmp_path / "stop.jsonl"
    stopped(path)

    def damage(head, lines):
        if change is None:
            head["config"] = head["state"]
        else:
            lines[1] |= change

    rewrite(path, damage)
    with pytest.raises(ConfigError, match="can't be replayed") as told:
        replay(path)
    assert len(str(told.value)) < 400


def test_a_huge_file_is_refused_at_once(tmp_path):
    path = tmp_path / "stop.jsonl"
    with path.open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(ConfigError, match="is larger than 64 MB"):
        replay(path)


@pytest.mark.parametrize("bound", ["MOST_INPUTS", "MOST_VALUES"])
def test_a_file_of_as_much_as_may_be_replayed_is_replayed(tmp_path, monkeypatch, bound):
    path = tmp_path / "stop.jsonl"
    count = len(stopped(path).entries)
    if bound == "MOST_VALUES":
        count = sum(path.read_text().count(mark) for mark in ",[{")
    monkeypatch.setattr(black_box, bound, count)
    assert replay(path).differing == ()
    monkeypatch.setattr(black_box, bound, count - 1)
    with pytest.raises(ConfigError, match="at most"):
        replay(path)


@pytest.mark.parametrize("name", ["dataclass", "array"])
def test_a_record_names_a_kind_of_record_and_nothing_else_of_its_modules(name):
    with pytest.raises(ValueError, match="can't be read"):
        from_plain({"kind": name})
