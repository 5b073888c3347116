from __future__ import annotations

import time

import numpy as np
import pytest
from pydantic import Field

from nics_drl_bridge.config import (
    MAX_BYTES,
    MAX_VALUES,
    Schema,
    dump_yaml,
    find_config,
    load_yaml,
    parse_yaml,
    share_folder,
    validate,
)
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.world import World


class Wheel(Schema):
    radius: float = Field(gt=0.0)
    tread: str = "plain"


class Cart(Schema):
    name: str
    mass: float = 1.0
    seats: int = 0
    wheels: tuple[Wheel, ...] = ()
    spare: Wheel | None = None
    extras: dict[str, float] = Field(default_factory=dict)


def value_of(text):
    return parse_yaml(f"key: {text}", "a.yaml")["key"]


def refusal(text, schema=Cart):
    with pytest.raises(ConfigError) as caught:
        validate(parse_yaml(text, "cart.yaml"), schema, "cart.yaml")
    sentence = str(caught.value)
    assert sentence.startswith("cart.yaml")
    assert "\n" not in sentence
    return sentence


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("1E5", 100000.0),
        ("-2.5e+2", -250.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("010", 10),
        ("-007", -7),
        ("12", 12),
        ("+3", 3),
    ],
)
def test_what_looks_like_a_decimal_number_is_that_number(text, value):
    assert value_of(text) == value
    assert not isinstance(value_of(text), str)


@pytest.mark.parametrize(
    "text",
    [
        "no",
        "yes",
        "on",
        "off",
        "Y",
        "0x10",
        "0b1",
        "0o7",
        "1_000",
        "12:30:45",
        "2024-01-31",
    ],
)
def test_what_is_a_surprise_in_yaml_1_1_stays_text(text):
    assert value_of(text) == text


@pytest.mark.parametrize(
    ("text", "value"), [("true", True), ("False", False), ("~", None)]
)
def test_truth_and_nothing_are_read(text, value):
    assert value_of(text) is value


@pytest.mark.parametrize(
    "text", ["a: 1\na: 2", "b: {a: 1, a: 1}", "b: [{c: 1, d: 2, c: 3}]"]
)
def test_a_key_that_stands_twice_is_refused(text):
    with pytest.raises(
        ConfigError, match=r"file.yaml, line \d: the key '[ac]' stands twice"
    ):
        parse_yaml(text, "file.yaml")


def test_a_merged_key_may_be_overridden():
    data = parse_yaml("base: &b {x: 1, y: 2}\nnew: {<<: *b, y: 3}", "a.yaml")
    assert data["new"] == {"x": 1, "y": 3}


@pytest.mark.parametrize("opening", ["[", "{a: "])
def test_deep_nesting_is_refused_before_it_is_built(opening):
    with pytest.raises(
        ConfigError, match="nested more than 32 levels deep; flatten it"
    ):
        parse_yaml("key: " + opening * 100_000, "a.yaml")


@pytest.mark.parametrize("key", ["spare", "extras"])
def test_a_value_in_place_of_keys_is_told_without_the_words_of_a_library(key):
    sentence = refusal(f"name: a\n{key}: [1, 2]\n")
    assert (
        sentence == f"cart.yaml: key '{key}': must hold `key: value` pairs, not [1, 2]."
    )


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("6", "must be a list, as [a, b], not 6."),
        ("[6]", "number of entries must be more than 1."),
        ("[6, 4, 2]", "number of entries must be at most 2, not 3."),
    ],
)
def test_a_list_is_asked_for_without_the_words_of_a_library(value, told):
    text = f"name: mine\nsize: {value}\nclearance: 0.4\ngoal_distance: [1.0, 2.0]\n"
    with pytest.raises(ConfigError) as caught:
        validate(parse_yaml(text, "mine.yaml"), World, "mine.yaml")
    assert str(caught.value) == f"mine.yaml: key 'size': {told}"


def test_thirty_levels_are_allowed():
    assert parse_yaml("key: " + "[" * 30 + "]" * 30, "a.yaml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "the file is empty"),
        ("# nothing\n", "the file is empty"),
        ("- 1\n- 2", "the top level must be"),
        ("just text", "the top level must be"),
        ("a: [1, 2", "a.yaml, line 1"),
        ("a: 1\n b: 2", "a.yaml, line 2"),
        ("a: \x00", "a.yaml"),
        ("a: !!python/object/apply:os.system ['true']", "a.yaml, line 1"),
        ("a: *nowhere", "a.yaml, line 1"),
        ("? [1, 2]\n: 3", "a.yaml, line 1"),
        ("? {b: 2}\n: 3", "a.yaml, line 1"),
        ("a: 1\n---\nb: 2", "a.yaml, line 2"),
    ],
)
def test_what_is_no_mapping_is_one_sentence(text, sentence):
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "a.yaml")
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_key_names_the_nearest():
    assert "unknown key 'mas'; did you mean 'mass'?" in refusal("name: a\nmas: 2")


def test_an_unknown_key_inside_a_list_names_its_place_and_the_nearest():
    sentence = refusal("name: a\nwheels: [{radius: 1}, {radius: 1, thread: flat}]")
    assert "unknown key 'wheels.1.thread'; did you mean 'tread'?" in sentence


def test_an_unknown_key_below_an_optional_part_names_the_nearest():
    assert "did you mean 'radius'?" in refusal("name: a\nspare: {radios: 1, radius: 1}")


def test_an_unknown_key_goes_before_the_missing_one_that_it_meant():
    assert "unknown key 'nam'; did you mean 'name'?" in refusal("nam: a")


def test_a_missing_key_is_named():
    assert "the key 'wheels.0.radius' is missing" in refusal("name: a\nwheels: [{}]")


@pytest.mark.parametrize(
    "text",
    [
        "mass: heavy",
        "mass: .inf",
        "mass: -.inf",
        "mass: .nan",
        "mass: 1e999",
        "seats: 1.5",
    ],
)
def test_a_wrong_value_is_shown_with_its_key(text):
    key, _, _ = text.partition(":")
    assert f"key '{key}'" in refusal(f"name: a\n{text}")


def test_a_limit_is_told_with_the_value():
    sentence = refusal("name: a\nwheels: [{radius: -2}]")
    assert "key 'wheels.0.radius'" in sentence
    assert "greater than 0, not -2" in sentence


def test_a_number_is_no_name():
    assert "key 'name'" in refusal("name: 12")


def test_aliases_that_multiply_are_refused_at_once():
    lines = ["l0: &l0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 12)]
    lines += ["name: *l11"]
    assert "more than 50000 values" in refusal("\n".join(lines))


def test_configurations_are_frozen_and_share_no_defaults():
    one = Cart(name="a")
    other = Cart(name="b")
    with pytest.raises(ValueError, match="frozen"):
        one.mass = 3.0
    assert one.extras is not other.extras


def test_written_yaml_reads_back_to_the_same_bits():
    rng = np.random.default_rng(0)
    numbers = (rng.normal(size=500) * 10.0 ** rng.uniform(-300, 300, 500)).tolist()
    data = {
        "numbers": [*numbers, 0.0, 5e-324, 1e-3, 1e16, 3.0],
        "whole": [0, -7, 10**20],
    }
    assert parse_yaml(dump_yaml(data), "a.yaml") == data


@pytest.mark.parametrize(
    "text",
    [
        "1e-3",
        "010",
        "09",
        "no",
        "null",
        "~",
        "true",
        "1.5",
        "5.",
        "- a",
        "",
        " a",
        "größe",
    ],
)
def test_written_text_reads_back_as_text(text):
    assert parse_yaml(dump_yaml({"key": text}), "a.yaml") == {"key": text}


def test_a_file_with_a_byte_order_mark_and_windows_lines_is_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes("\ufeffname: größe\r\nmass: 2\r\n".encode())
    assert load_yaml(path, Cart) == Cart(name="größe", mass=2.0)


def test_files_that_cant_be_read_are_one_sentence(tmp_path):
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("name: größe".encode("latin-1"))
    for path, reason in (
        (tmp_path / "nowhere.yaml", "no such file"),
        (tmp_path, "is a folder"),
        (latin, "is not UTF-8"),
    ):
        with pytest.raises(ConfigError, match=reason) as caught:
            load_yaml(path, Cart)
        assert str(path) in str(caught.value)


def test_a_shipped_file_is_found_by_name_and_any_by_path(tmp_path):
    assert (
        find_config("arena", "worlds")
        == share_folder() / "config" / "worlds" / "arena.yaml"
    )
    assert find_config("some/where.yaml", "worlds").as_posix() == "some/where.yaml"


def test_an_unknown_name_gives_the_nearest():
    with pytest.raises(ConfigError) as caught:
        find_config("akermann", "robots")
    assert str(caught.value) == (
        "unknown robot 'akermann'; did you mean 'ackermann'? (or give the path of a YAML file)."
    )


SOON_S = 2.0
TAGS = (
    "!!python/name:os.system",
    "!!int",
    "!!float",
    "!!bool",
    "!!timestamp",
    "!!binary",
    "!!set",
    "!!omap",
    "!!pairs",
    "!!str",
    "!!map",
    "!!seq",
    "!own",
    "!",
)
VALUES = ('"abc"', '""', "[1]", "{a: 1}", '"%%%"')


def refused_soon(text: str) -> str:
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
    assert f"more than {MAX_VALUES} values" in refused_soon(merges(levels, times))


@pytest.mark.parametrize(("levels", "times"), [(3, 3), (10, 1)])
def test_merge_keys_that_stay_small_are_read(levels, times):
    assert parse_yaml(merges(levels, times), "a.yaml")[f"m{levels - 1}"] == {"x": 1}


@pytest.mark.parametrize(
    "text", ["a: &a {<<: *a}", "a: &a [1, *a]", "a: &a {b: {c: *a}}"]
)
def test_an_alias_of_itself_is_refused(text):
    assert "line 1: the alias 'a' stands within itself" in refused_soon(text)


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("tag", TAGS)
def test_a_tag_is_one_sentence_with_its_line(tag, value):
    assert "a.yaml, line 2: the tag" in refused_soon(f"x: 1\na: {tag} {value}")


@pytest.mark.parametrize(
    "text", ["!!int abc: 1", "? !!set {a}\n: 1", "%TAG ! !!\n---\na: !int 1"]
)
def test_a_tag_of_a_key_or_of_another_name_is_found(text):
    assert "the tag" in refused_soon(text)


@pytest.mark.slow
def test_very_many_values_are_refused_before_they_are_all_read():
    assert "more than" in refused_soon(f"a: [{'1,' * (MAX_BYTES // 2 - 10)}]")


def test_a_text_that_is_too_large_is_refused_unread():
    assert "larger than 1 MB" in refused_soon(f"a: {'x' * MAX_BYTES}")


@pytest.mark.parametrize(
    "text", ["a: " + "9" * 10_000, "a: {b: -" + "1" * 500_000 + "}"]
)
def test_a_number_of_very_many_digits_is_refused_with_its_line(text):
    assert "line 1: a number of" in refused_soon(text)


def test_a_long_key_or_alias_is_not_told_whole():
    assert "stands twice" in refused_soon(f"{'k' * 500}: 1\n{'k' * 500}: 2")
    assert "line 1" in refused_soon(f"a: *{'n' * 5000}")


@pytest.mark.slow
def test_many_short_values_are_read_as_before():
    pairs = "[0.125, -1.5], " * 16_000
    assert len(parse_yaml(f"points: [{pairs}]", "a.yaml")["points"]) == 16_000
