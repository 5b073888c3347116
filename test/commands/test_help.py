from __future__ import annotations

import shlex
from string import ascii_lowercase

import pytest
import typer
from command_line import nics

from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.policy import policies


def commands(group, before=()):
    """Every command below a group of click, by its words."""
    for name, command in group.commands.items():
        words = (*before, name)
        if hasattr(command, "commands"):
            yield from commands(command, words)
        else:
            yield words, command


KNOWN = dict(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("name", KNOWN)
def test_a_command_has_examples_of_options_that_there_are(name):
    options = {option for each in KNOWN[name].params for option in each.opts}
    _, head, *examples = KNOWN[name].epilog.splitlines()
    assert head == "Examples:"
    assert examples
    for example in examples:
        words = shlex.split(example)
        assert words[: len(name) + 1] == ["nics", *name]
        assert {word for word in words if word.startswith("--")} <= options


def test_units_survive_in_the_help_and_an_example_ends_it(tmp_path):
    told = nics("record --help", cwd=tmp_path).stdout
    assert "keep within [m]." in " ".join(told.split())
    assert told.rstrip().splitlines()[-1].strip().startswith("nics record --robot")


@pytest.mark.parametrize("words", [(), ("world",), ("bag",), ("policy",)])
def test_no_line_of_a_list_of_commands_is_cut(words, tmp_path):
    told = nics(*words, "--help", cwd=tmp_path).stdout
    assert "..." not in told.partition("Commands:")[2]


def test_units_survive_in_the_heads_of_tables(tmp_path):
    told = nics("list worlds", cwd=tmp_path).stdout
    assert "size [m]" in told


def test_options_complete_to_what_is_shipped_and_to_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"cellular", "circles"} <= set(console.WORLDS("c"))
    assert console.WORLDS("barn") == ["barn"]
    offered = {each for letter in ascii_lowercase for each in console.POLICIES(letter)}
    assert offered == {*policies.POLICIES, *policies.list_shipped_policies()}
    (tmp_path / "diff_mine.yaml").write_text("")
    assert console.ROBOTS("diff") == ["differential", "diff_mine.yaml"]


def test_every_option_that_takes_a_shipped_name_completes():
    lacking = [
        f"{' '.join(words)} {one.name}"
        for words, command in KNOWN.items()
        for one in command.params
        if "shipped" in (getattr(one, "help", "") or "").lower()
        and one._custom_shell_complete is None
    ]
    assert lacking == []


def test_every_command_but_the_page_speaks_json():
    mute = {
        name
        for name, command in KNOWN.items()
        if not any("--json" in option.opts for option in command.params)
    }
    assert mute == {("up",), ("watch",)}
