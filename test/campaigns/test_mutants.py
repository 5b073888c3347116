from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path

import pytest

from .campaign import FOLDER, ROOT

sys.path.insert(0, str(FOLDER))
mutants = import_module("mutants")

SOURCE = '''"""A limit of 3, and of 4."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    SIZE = 5

__all__ = ["limit"[0:9]]
LARGEST = 2.5


@cache(maxsize=7)
def limit(values: Annotated[float, 6], low: int = 1) -> Annotated[float, 8]:
    if low < 0:
        raise ValueError(f"low is {low + 1}" + str(low - 2))
    note(values)
    return [min(value, LARGEST) * 2 for value in zip(values, low, strict=True)]
'''


@pytest.fixture
def tree(tmp_path) -> Path:
    """A tree with the room `gate`, whose one module is limits.py."""
    folder = tmp_path / mutants.PACKAGE / "gate"
    folder.mkdir(parents=True)
    (folder / "limits.py").write_text(SOURCE)
    return tmp_path


def lines_of(tree: Path) -> set[tuple[str, str, str]]:
    """Kind, old line and new line of all mutants."""
    source = (tree / mutants.PACKAGE / "gate" / "limits.py").read_text()
    found = [x.describe(source) for x in mutants.find_mutants(tree, "gate")]
    return {(x["kind"], x["before"], x["after"]) for x in found}


def mutated(tree: Path, line: str) -> set[tuple[str, str]]:
    """Kind and new line of the mutants of a module of one line."""
    file = tree / mutants.PACKAGE / "gate" / "limits.py"
    file.write_text(line + "\n")
    return {(kind, after) for kind, _, after in lines_of(tree)}


def test_code_is_mutated_but_no_annotation_message_or_decorator(tree):
    loop = "return [min(value, LARGEST) * 2 for value in zip(values, low, strict=True)]"
    head = "def limit(values: Annotated[float, 6], low: int=1) -> Annotated[float, 8]:"
    assert lines_of(tree) == {
        ("constant", "LARGEST = 2.5", "LARGEST = 3.5"),
        ("constant", head, head.replace("=1", "=2")),
        ("condition", "if low < 0:", "if True:"),
        ("condition", "if low < 0:", "if False:"),
        ("comparison", "if low < 0:", "if low > 0:"),
        ("boundary", "if low < 0:", "if low <= 0:"),
        ("constant", "if low < 0:", "if low < 1:"),
        ("call", "note(values)", "pass"),
        ("return", loop, "return None"),
        ("arithmetic", loop, loop.replace("*", "/")),
        ("constant", loop, loop.replace("* 2", "* 3")),
    }


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("x = a + b", {("arithmetic", "x = a - b")}),
        ("x = (a)  # + c", set()),
        ("x **= a", {("arithmetic", "x *= a")}),
        ("x = -a // b", {("arithmetic", "x = a // b"), ("arithmetic", "x = -a * b")}),
        ("x = 'a' + b", set()),
        ("x = a is not b", {("comparison", "x = a is b")}),
        ("x = a not in b", {("comparison", "x = a in b")}),
        ("x = (a) == (b)", {("comparison", "x = a != b")}),
        ("x = a and b", {("boolean", "x = a or b")}),
        (
            "x = a and b and c",
            {("boolean", "x = a or (b and c)"), ("boolean", "x = a and b or c")},
        ),
        (
            "x = a or b or c",
            {("boolean", "x = a and b or c"), ("boolean", "x = a or (b and c)")},
        ),
        ("x = not(a)", {("boolean", "x = a")}),
        ("x = ~a", {("boolean", "x = a")}),
        ("f(x=True)", {("call", "pass"), ("boolean", "f(x=False)")}),
        ("x = 1e300", {("constant", "x = 2e+300")}),
        (
            "x = a if b else c",
            {("condition", f"x = a if {o} else c") for o in (True, False)},
        ),
        ("while a: pass", {("condition", "while False:")}),
        ("def f(): return False", {("boolean", "return True")}),
    ],
)
def test_each_place_has_the_mutants_of_its_kind(tree, line, expected):
    assert mutated(tree, line) == expected


def test_a_mutant_compiles_and_differs_in_one_place():
    drawn = mutants.draw(ROOT, 1, ("gate",), 24)
    assert {mutant.kind for mutant in drawn} == set(mutants.KINDS)
    for mutant in drawn:
        source = (ROOT / mutant.file).read_text()
        before = ast.unparse(ast.parse(source)).split("\n")
        after = ast.unparse(ast.parse(mutant.write(source))).split("\n")
        changed = [one != other for one, other in zip(before, after, strict=True)]
        assert sum(changed) == 1, mutant


def test_a_seed_draws_the_same_mutants_after_a_change_of_other_places(tree):
    file = tree / mutants.PACKAGE / "gate" / "limits.py"
    before = [mutant.key for mutant in mutants.draw(tree, 7, ("gate",), 6)]
    file.write_text("# A head.\n\n" + SOURCE.replace("value", "element"))
    after = [mutant.key for mutant in mutants.draw(tree, 7, ("gate",), 6)]
    other = [mutant.key for mutant in mutants.draw(tree, 8, ("gate",), 6)]
    assert before == after != other


def test_a_larger_draw_contains_the_smaller_one_and_rooms_have_equal_parts():
    few = mutants.draw(ROOT, 54, ("gate", "env"), 9)
    assert set(few) < set(mutants.draw(ROOT, 54, ("gate", "env"), 30))
    assert [mutant.room for mutant in few] == ["gate"] * 5 + ["env"] * 4


def test_the_module_itself_stays_when_its_copy_is_broken(tree):
    snapshot = tree / "snapshot"
    target = tree / "copy"
    (snapshot / "room").mkdir(parents=True)
    source = snapshot / "room" / "limits.py"
    source.write_text("LARGEST = 1\n")
    (snapshot / "room" / "limits.cpython.pyc").write_text("older code")
    mutants.copy_snapshot(snapshot, target)
    (target / "room" / "limits.py").write_text("LARGEST = 2\n")
    assert source.read_text() == "LARGEST = 1\n"
    assert not (target / "room" / "limits.cpython.pyc").exists()


@pytest.mark.campaign
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("control", mutants.CONTROLS)
def test_a_room_notices_a_mutant_that_raises_and_no_other_control(tmp_path, control):
    options = ["--rooms", "gate", "--control", control]
    assert mutants.main([*options, "--out", str(tmp_path / "out.jsonl")]) == 0
