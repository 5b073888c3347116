from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def hooks():
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location(
        "site_hooks", ROOT / "docs" / "site" / "hooks.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_four_equations_of_the_paper_are_formulas_with_their_numbers(hooks):
    page = hooks.with_formulas((ROOT / "docs" / "paper.md").read_text())
    numbers = [f'class="equation-number">({number})' for number in (1, 2, 3, 4)]
    assert all(number in page for number in numbers)
    assert page.count('display="block"') == 4
    assert "$" not in page
    formulas = [part.split("</math>")[0] for part in page.split("<math")[1:]]
    assert not any("\\" in formula or "<mi>&</mi>" in formula for formula in formulas)
    code = "run `echo $HOME and $PATH`\n\n```\na $x$ b\n```\n"
    assert hooks.with_formulas(code) == code


def test_a_formula_at_the_beginning_of_a_line_stays_in_its_sentence(hooks):
    markdown = pytest.importorskip("markdown")
    page = markdown.markdown(
        hooks.with_formulas("the angle\n$\\varphi$. With $X$,\n$x$ is small")
    )
    assert page.count("<p>") == 1
    assert page.index("the angle") < page.index("<math") < page.index("is small</p>")


def test_a_name_in_a_table_is_broken_at_its_joints_only(hooks):
    cell = "<td>see <code>a/bc_d.py</code> and <code>x</code></td>"
    broken = "<td>see <code>a/<wbr>bc_<wbr>d.<wbr>py</code> and <code>x</code></td>"
    sentence = "<p><code>a/bc_d.py</code></p>"
    assert (
        hooks.with_break_points(sentence + cell + sentence)
        == sentence + broken + sentence
    )
