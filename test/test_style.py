import io

import matplotlib as mpl
import pytest
from PIL import Image

from nics_drl_bridge import style


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
