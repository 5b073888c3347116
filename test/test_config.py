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
from nics_drl_bridge.errors import ConfigError, UnknownNameError


class Wheel(Schema):
    radius: float = Field(gt=0.0)
    tread: str = "plain"


class Cart(Schema):
    name: str
    mass: float = 1.0
    seats: int = 0
    wheels: tuple[Wheel, ...] = ()
    size: tuple[float, float] = (1.0, 1.0)
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
    "text", ["a: 1\na: 2", "b: {a: 1, a: 1}", "b: [{c: 1, d: 2, c: 3}]"]
)
def test_a_key_that_stands_twice_is_refused(text):
    with pytest.raises(
        ConfigError, match=r"file.yaml, line \d: the key '[ac]' occurs twice"
    ):
        parse_yaml(text, "file.yaml")


def test_a_merged_key_may_be_overridden():
    data = parse_yaml("base: &b {x: 1, y: 2}\nnew: {<<: *b, y: 3}", "a.yaml")
    assert data["new"] == {"x": 1, "y": 3}


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


def test_a_shipped_file_is_found_by_name_and_any_by_path(tmp_path):
    assert (
        find_config("arena", "worlds")
        == share_folder() / "config" / "worlds" / "arena.yaml"
    )
    assert find_config("some/where.yaml", "worlds").as_posix() == "some/where.yaml"


VALUES = {
    "1e-3": 0.001,
    "1E5": 1e5,
    "-2.5e+2": -250.0,
    ".5": 0.5,
    "5.": 5.0,
    "010": 10,
    "-007": -7,
    "12": 12,
    "+3": 3,
    "true": True,
    "False": False,
    "~": None,
    # What YAML 1.1 makes something else of.
    **{text: text for text in ("no", "yes", "on", "Y", "0x10", "0b1", "0o7", "1_000")},
    **{text: text for text in ("12:30:45", "2024-01-31")},
}


@pytest.mark.parametrize("text", VALUES)
def test_a_value_is_what_it_looks_like(text):
    value = value_of(text)
    assert value == VALUES[text]
    assert isinstance(value, bool) == isinstance(VALUES[text], bool)


@pytest.mark.parametrize(
    ("text", "key", "told"),
    [
        ("name: a\nmas: 2", "mas", "did you mean 'mass'"),
        ("nam: a", "nam", "did you mean 'name'"),
        ("name: a\nspare: {radios: 1, radius: 1}", "spare.radios", "'radius'"),
        (
            "name: a\nwheels: [{radius: 1}, {radius: 1, thread: flat}]",
            "wheels.1.thread",
            "did you mean 'tread'",
        ),
        ("name: a\nwheels: [{}]", "wheels.0.radius", "is missing"),
        ("name: a\nwheels: [{radius: -2}]", "wheels.0.radius", "than 0, not -2"),
        ("name: 12", "name", "not 12"),
        ("name: a\nspare: [1, 2]", "spare", "`key: value` pairs, not [1, 2]."),
        ("name: a\nextras: [1, 2]", "extras", "`key: value` pairs, not [1, 2]."),
        ("name: a\nwheels: 6", "wheels", "must be a list such as [a, b], not 6."),
        ("name: a\nsize: [6]", "size", "must be more than 1."),
        ("name: a\nsize: [6, 4, 2]", "size", "must be at most 2, not 3."),
        *(
            (f"name: a\nmass: {value}", "mass", "")
            for value in ("heavy", ".inf", "-.inf", ".nan", "1e999", "true", "'1'")
        ),
        ("name: a\nseats: 1.5", "seats", ""),
    ],
)
def test_a_wrong_key_or_value_is_told_with_its_place(text, key, told):
    sentence = refusal(text)
    assert f"key '{key}'" in sentence
    assert told in sentence


SOON_S = 2.0


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


ALIASES = "\n".join(
    [
        "l0: &l0 [x, x, x, x, x, x, x, x, x]",
        *(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 12)),
    ]
)
HOSTILE = {
    ALIASES: f"more than {MAX_VALUES} values",
    **{
        merges(*size): f"more than {MAX_VALUES} values"
        for size in ((7, 9), (24, 2), (2, 60_000))
    },
    "a: &a {<<: *a}": "the alias 'a' contains itself",
    "a: &a [1, *a]": "line 1: the alias 'a' contains itself",
    **{f"x: 1\na: {tag} {'[1]'}": "line 2: the tag" for tag in ("!!int", "!!set")},
    "x: 1\na: !!python/name:os.system 1": "line 2: the tag",
    "!!int abc: 1": "the tag",
    "%TAG ! !!\n---\na: !int 1": "the tag",
    f"a: [{'1,' * (MAX_BYTES // 2 - 10)}]": "more than",
    f"a: {'x' * MAX_BYTES}": "larger than 1 MB",
    "a: " + "9" * 10_000: "line 1: a number of",
    "a: " + "[" * 100_000: "nested more than 32 levels deep; flatten it",
    "a: " + "{b: " * 100_000: "nested more than 32 levels deep",
    f"{'k' * 500}: 1\n{'k' * 500}: 2": "occurs twice",
    f"a: *{'n' * 5000}": "line 1",
}


@pytest.mark.parametrize("number", range(len(HOSTILE)))
def test_what_would_grow_without_end_or_run_code_is_refused_soon(number):
    text, told = list(HOSTILE.items())[number]
    assert told in refused_soon(text)


@pytest.mark.parametrize(("levels", "times"), [(3, 3), (10, 1)])
def test_merge_keys_that_stay_small_are_read(levels, times):
    assert parse_yaml(merges(levels, times), "a.yaml")[f"m{levels - 1}"] == {"x": 1}


def test_a_file_with_a_byte_order_mark_and_windows_lines_is_read(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes("\ufeffname: größe\r\nmass: 2\r\n".encode())
    assert load_yaml(path, Cart) == Cart(name="größe", mass=2.0)


def test_long_nested_and_numerous_values_are_read():
    pairs = "[0.125, -1.5], " * 16_000
    assert len(parse_yaml(f"points: [{pairs}]", "a.yaml")["points"]) == 16_000
    assert parse_yaml("key: " + "[" * 30 + "]" * 30, "a.yaml")


def test_an_unknown_name_gives_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'ackermann'") as caught:
        find_config("akermann", "robots")
    assert caught.value.kind == "robots"
