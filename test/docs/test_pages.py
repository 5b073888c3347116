"""What the pages say a user can type: each command exists, each piece of Python compiles."""

from __future__ import annotations

import re
import shlex
from importlib import import_module
from pathlib import Path

import pytest
from typer.main import get_command

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.commands.listing import worlds

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
MAKE_TARGETS = set(
    re.findall(
        r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
    )
)
FENCED = re.compile(
    r"^```(?P<kind>[a-z]*)\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL
)
INDENTED = re.compile(r"(?<=\n\n)(?:    .*\n+)+")
INLINE = re.compile(r"`((?:nics|make) [^`\n]+)`")
FROM_INDEX = re.compile(r"pip install.*nics_drl_bridge\b")
FOLDERS = "|".join(
    sorted(each.parent.name for each in ROOT.glob("nics_drl_bridge/*/__init__.py"))
)
DOTTED = re.compile(
    rf"`((?:(?:nics_drl_bridge\.)?(?:{FOLDERS})(?:\.\w+){{2,}})|[a-z_]+(?:\.[a-z_]+)+\.[A-Z]\w+)[`(]"
)
OPTIONAL = {"rclpy", "mujoco", "torch", "stable_baselines3", "pettingzoo", "onnx"}
PLACEHOLDERS = {"...", "NAME"}
SOURCES = ("world.py", "state.py", "obstacle_kernels.py")
"""Where a motion of obstacles is added."""


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def command_lines(text: str) -> list[str]:
    """Lines that begin with `nics` or `make`, in blocks and between backticks."""
    plain = re.sub(r"\\\n\s+", "", FENCED.sub("", text))
    lines = [
        line.strip() for block in INDENTED.findall(plain) for line in block.splitlines()
    ]
    lines += INLINE.findall(plain)
    return [line for line in lines if line.startswith(("nics ", "make "))]


def words_of(line: str) -> list[str]:
    return shlex.split(line.replace("'...", "'").replace("...", ""), comments=True)[1:]


def check_options(words: list[str]) -> None:
    """Raises AssertionError for a command or an option of `nics` that does not exist."""
    command = get_command(app)
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name = words.pop(0)
        if name in PLACEHOLDERS:
            return
        assert name in command.commands, f"there is no command {name!r}"
        command = command.commands[name]
    known = {opt for one in command.params for opt in (*one.opts, *one.secondary_opts)}
    known |= {"--help", "--version"}
    for word in words:
        if word.startswith("-") and not re.fullmatch(r"-[\d.]+(,.*)?", word):
            assert word.split("=")[0] in known, f"{command.name} has no option {word!r}"


CASES = [(page, line) for page in PAGES for line in command_lines(text_of(page))]


@pytest.mark.parametrize(("page", "line"), CASES, ids=lambda value: str(value)[-60:])
def test_every_command_that_a_page_shows_exists(page, line):
    words = words_of(line)
    if line.startswith("nics "):
        check_options(words)
    else:
        targets = [
            word for word in words if "=" not in word and not word.startswith("-")
        ]
        assert set(targets) <= MAKE_TARGETS, f"{page.name}: {line}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_page_and_file_that_a_page_names_exists(page):
    named = re.findall(
        r"`((?:docs|examples|config|benchmarks|test)/[\w/.-]+\.\w+)`", text_of(page)
    )
    named += [
        str((page.parent / to).resolve().relative_to(ROOT))
        for to in re.findall(
            r"\]\((?![a-z]+:)([^)#\s]+)", FENCED.sub("", text_of(page))
        )
    ]
    made = {"docs/CHANGELOG.md", "docs/CONTRIBUTING.md"}
    notebooks = {
        f"docs/notebooks/{p.stem}.md" for p in (ROOT / "docs/notebooks").glob("*.ipynb")
    }
    missing = [
        one
        for one in named
        if one not in made | notebooks and not (ROOT / one).exists()
    ]
    assert not [one for one in missing if "NAME" not in one and "ROBOT" not in one]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_installs_from_the_folder_as_no_index_has_the_package(page):
    """What the commands say is another matter: there it is installed, and pip adds the extra."""
    lines = text_of(page).splitlines()
    wrong = [
        line
        for line in lines
        if FROM_INDEX.search(line) and not line.startswith("    nics:")
    ]
    assert not wrong


def resolved(name: str) -> object:
    """What a dotted name stands for in the package, or else in a library."""
    place, _, attribute = name.removeprefix("nics_drl_bridge.").rpartition(".")
    if (ROOT / "nics_drl_bridge" / place.split(".")[0]).exists():
        place = f"nics_drl_bridge.{place}"
    return getattr(import_module(place), attribute)


NAMES = sorted(
    {(page, name) for page in PAGES for name in DOTTED.findall(text_of(page))}
)


@pytest.mark.parametrize(("page", "name"), NAMES, ids=lambda value: str(value)[-60:])
def test_every_name_of_the_package_that_a_page_gives_is_there(page, name):
    try:
        assert resolved(name)
    except ModuleNotFoundError as error:
        if error.name in OPTIONAL:
            pytest.skip(f"needs {error.name}")
        raise


def test_every_world_and_set_that_is_listed_stands_in_the_table_of_worlds():
    page = (ROOT / "docs" / "worlds.md").read_text(encoding="utf-8")
    table = page.partition("## The shipped ones")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert sorted(rows) == sorted(row["name"] for row in worlds())


def test_the_steps_to_a_motion_of_obstacles_name_what_the_files_hold():
    page = text_of(ROOT / "docs" / "extensions.md")
    (steps,) = re.findall(r"^## A motion of obstacles\n(.*?)^## ", page, re.M | re.S)
    files = [ROOT / "nics_drl_bridge" / "sim" / name for name in SOURCES]
    source = "".join(map(text_of, files))
    named = set(re.findall(r"`([A-Za-z_]{5,})[`(]", steps)) - {"orbit", "ORBIT"}
    assert {"plan_arrays", "ObstaclePlan", "reset_marks"} <= named
    assert [name for name in named if name not in source] == []


def test_what_a_page_shows_is_found_and_what_there_is_not_is_noticed():
    text = "`nics urdf X`, `env.task.total`, `sim.device.Simulator`, not `env.step(a)`.\n\n"
    assert command_lines(f"{text}    make demo\n\nMore.\n") == [
        "make demo",
        "nics urdf X",
    ]
    known, unknown = DOTTED.findall(text)
    assert resolved(known)
    with pytest.raises(AttributeError):
        resolved(unknown)
    for line in ("nics trian --robot x", "nics train --robott x", "nics world drew x"):
        with pytest.raises(AssertionError):
            check_options(words_of(line))
