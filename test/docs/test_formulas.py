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


def test_a_dollar_in_code_is_no_formula(hooks):
    text = "run `echo $HOME and $PATH`\n\n```\na $x$ b\n```\n"
    assert hooks.with_formulas(text) == text
