from __future__ import annotations

import io
import re
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

import nics_drl_bridge
from nics_drl_bridge import style

PACKAGE = Path(nics_drl_bridge.__file__).parent
DRAWING = [*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "benchmarks").glob("*.py")]


def test_all_pictures_take_their_colours_from_the_style():
    own = [
        file.name
        for file in DRAWING
        if file.name != "style.py"
        and re.search("[\"']#[0-9a-fA-F]{6}[\"']", file.read_text("utf-8"))
    ]
    assert own == []


def test_measured_model_and_goal_differ_in_grey_too():
    weights = 0.2126, 0.7152, 0.0722
    colours = (style.MEASURED, style.MODEL, style.GOAL)
    grey = sorted(
        sum(w * c for w, c in zip(weights, to_rgb(each), strict=True))
        for each in colours
    )
    assert min(b - a for a, b in pairwise(grey)) > 0.05


def test_the_style_ends_with_the_picture():
    before = mpl.rcParams["axes.spines.top"], mpl.rcParams["font.size"]
    _, (axes,) = style.make_panels(1, 1, (3.0, 2.0))
    assert not axes.spines["top"].get_visible()
    assert (mpl.rcParams["axes.spines.top"], mpl.rcParams["font.size"]) == before


@pytest.mark.parametrize("columns", [1, 3])
def test_no_title_is_cut(columns):
    figure, grid = style.make_panels(1, columns, (3.0 * columns, 2.5))
    for axes in grid:
        axes.plot([0.0, 1.0], [0.0, 1.0], label="line")
        axes.set_title(
            "clock offset -3.001 +- 0.010 s, which is known from the wheels alone"
        )
    image = Image.open(io.BytesIO(style.render_png(figure, grid[0])))
    assert image.width == 330 * columns
    for n, axes in enumerate(grid):
        title = axes.title.get_window_extent()
        width = figure.bbox.width / columns
        assert n * width - 3.0 <= title.x0 < title.x1 <= (n + 1) * width + 3.0


def test_a_panel_without_data_is_left_empty():
    figure, grid = style.make_panels(1, 2, (4.0, 2.0))
    grid[0].plot([0.0, 1.0], [0.0, 1.0])
    style.render_png(figure)
    assert [axes.axison for axes in grid] == [True, False]
