"""What callers pass to public functions is checked, and a robot goes by either of two words."""

from typing import Any

import pytest

import nics_drl_bridge
from nics_drl_bridge.arguments import (
    check_arguments,
    check_count,
    check_path,
    format_value,
)
from nics_drl_bridge.errors import BridgeError, ConfigError


@check_arguments("drive")
def drive(
    model: str = "ackermann", metres: float = 1.0, turns: int | None = None
) -> Any:
    """Returns its arguments."""
    return model, metres, turns


@pytest.mark.parametrize("word", ["robot", "model"])
def test_either_word_names_the_robot(word: str):
    assert drive(**{word: "jackal"})[0] == "jackal"


@pytest.mark.parametrize("first", [{"model": "ackermann"}, {}])
def test_two_words_for_two_robots_are_refused(first: dict[str, Any]):
    given = () if first else ("ackermann",)
    with pytest.raises(
        ConfigError, match=r"model='ackermann' and robot='jackal'.*give one"
    ):
        drive(*given, robot="jackal", **first)  # type: ignore[call-arg]


def test_an_unknown_keyword_is_told_with_the_nearest_one():
    with pytest.raises(
        ConfigError, match="drive: unknown argument 'metre'; did you mean 'metres'"
    ):
        drive(metre=2.0)  # type: ignore[call-arg]


@pytest.mark.parametrize("value", [None, "1", [1.0], float("nan"), float("inf"), True])
def test_a_value_that_is_no_number_is_refused(value: Any):
    with pytest.raises(ConfigError, match=r"drive: metres=.*must be a finite number"):
        drive(metres=value)


def test_a_value_that_may_be_none_is_accepted_as_none():
    assert drive(turns=None)[2] is None
    with pytest.raises(
        ConfigError, match=r"turns=1\.5: must be a whole number, or None"
    ):
        drive(turns=1.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [0, -1, 1.5, True, None, "3", float("nan"), 2**31])
def test_a_count_is_a_whole_number_of_at_least_one(value: Any):
    with pytest.raises(ConfigError, match="must be a whole number"):
        check_count("num_envs", value)


@pytest.mark.parametrize("value", [3, None, True, ["a"], "a\0b"])
def test_a_path_is_text_or_a_path(value: Any):
    with pytest.raises(ConfigError, match="path"):
        check_path("folder", value)


OPENERS = ("model", "policy", "recording", "robot", "world", "worlds")


@pytest.mark.parametrize("value", [3, None, [], True, {}, object(), "a\0b"])
@pytest.mark.parametrize("name", OPENERS)
def test_what_is_no_path_is_refused_by_all_that_opens_one(name: str, value: Any):
    with pytest.raises(BridgeError) as caught:
        getattr(nics_drl_bridge, f"load_{name}")(value)
    assert "\n" not in str(caught.value)


def test_a_large_object_is_quoted_by_its_type():
    assert format_value([1.0] * 1000) == "of type list"
