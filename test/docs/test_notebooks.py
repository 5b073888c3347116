"""The notebooks run from their first cell to their last, and hold what they said when they did."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs" / "site"))
nbformat = pytest.importorskip("nbformat")
notebooks = pytest.importorskip("notebooks")
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_of_a_notebook_was_run_and_none_failed(path):
    cells = code_cells(nbformat.read(path, as_version=4))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {one.output_type for cell in cells for one in cell.outputs}
    assert "error" not in kinds
    assert "stream" in kinds
    assert path.stat().st_size < 200_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(900)  # a cold start compiles
def test_a_notebook_runs(path):
    cells = code_cells(notebooks.run(path))
    assert all(cell.outputs for cell in cells)
