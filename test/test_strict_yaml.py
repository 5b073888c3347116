"""YAML that grows, and YAML that wants objects made: one sentence with the line, at once."""

from __future__ import annotations

import time

import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.strict_yaml import MAX_BYTES, MAX_VALUES, parse_yaml

SOON_S = 2.0
TAGS = ("!!python/name:os.system", "!!int", "!!float", "!!bool", "!!timestamp", "!!binary", "!!set",
        "!!omap", "!!pairs", "!!str", "!!map", "!!seq", "!own", "!")  # fmt: skip
VALUES = ('"abc"', '""', "[1]", "{a: 1}", '"%%%"')


def refusal(text: str) -> str:
    begin = time.process_time()
    with pytest.raises(ConfigError) as told:
        parse_yaml(text, "a.yaml")
    assert time.process_time() - begin < SOON_S
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 300
    return str(told.value)


def merges(levels: int, times: int) -> str:
    lines = ["m0: &m0 {x: 1}"]
    for k in range(1, levels):
        lines.append(f"m{k}: &m{k} {{<<: [{', '.join([f'*m{k - 1}'] * times)}]}}")
    return "\n".join(lines)


@pytest.mark.parametrize(("levels", "times"), [(7, 9), (24, 2), (2, 60_000)])
def test_merge_keys_that_multiply_are_refused_at_once(levels, times):
    assert f"more than {MAX_VALUES} values" in refusal(merges(levels, times))


@pytest.mark.parametrize(("levels", "times"), [(3, 3), (10, 1)])
def test_merge_keys_that_stay_small_are_read(levels, times):
    assert parse_yaml(merges(levels, times), "a.yaml")[f"m{levels - 1}"] == {"x": 1}


@pytest.mark.parametrize("text", ["a: &a {<<: *a}", "a: &a [1, *a]", "a: &a {b: {c: *a}}"])
def test_an_alias_of_itself_is_refused(text):
    assert "line 1: the alias 'a' stands within itself" in refusal(text)


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("tag", TAGS)
def test_a_tag_is_one_sentence_with_its_line(tag, value):
    assert "a.yaml, line 2: the tag" in refusal(f"x: 1\na: {tag} {value}")


@pytest.mark.parametrize("text", ["!!int abc: 1", "? !!set {a}\n: 1", "%TAG ! !!\n---\na: !int 1"])
def test_a_tag_of_a_key_or_of_another_name_is_found(text):
    assert "the tag" in refusal(text)


def test_very_many_values_are_refused_before_they_are_all_read():
    assert "more than" in refusal(f"a: [{'1,' * (MAX_BYTES // 2 - 10)}]")


def test_a_text_that_is_too_large_is_refused_unread():
    assert "larger than 1 MB" in refusal(f"a: {'x' * MAX_BYTES}")


@pytest.mark.parametrize("text", ["a: " + "9" * 10_000, "a: {b: -" + "1" * 500_000 + "}"])
def test_a_number_of_very_many_digits_is_refused_with_its_line(text):
    assert "line 1: a number of" in refusal(text)


def test_a_long_key_or_alias_is_not_told_whole():
    assert "stands twice" in refusal(f"{'k' * 500}: 1\n{'k' * 500}: 2")
    assert "line 1" in refusal(f"a: *{'n' * 5000}")


def test_many_short_values_are_read_as_before():
    pairs = "[0.125, -1.5], " * 16_000
    assert len(parse_yaml(f"points: [{pairs}]", "a.yaml")["points"]) == 16_000
