"""The style of all pictures: fonts, and the colours of Okabe and Ito for the colour-blind."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from textwrap import fill
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
BLACK = "#000000"
SERIES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MEASURED = BLUE
MODEL = VERMILION
GOAL = ORANGE
OTHER = "#8d99ae"
DARK = "#333333"
EDGE = "#c5cbd3"
# looks of lines and points
MEASURED_LINE: dict[str, Any] = {"color": MEASURED, "linewidth": 2.5, "alpha": 0.55}
MODEL_LINE: dict[str, Any] = {"color": MODEL, "linewidth": 1.4}
POINTS: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3}
# markers for `SERIES`, for prints without colours
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
RC: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": OTHER,
    "axes.grid": True,
    "axes.labelcolor": DARK,
    "axes.labelsize": 9.5,
    "axes.prop_cycle": cycler(color=SERIES),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": DARK,
    "axes.titlesize": 10.0,
    "font.size": 10.0,
    "grid.alpha": 0.3,
    "legend.fontsize": 9.0,
    "legend.frameon": False,
    "savefig.dpi": 110.0,
    "text.color": DARK,
    "xtick.color": DARK,
    "xtick.labelsize": 9.0,
    "ytick.color": DARK,
    "ytick.labelsize": 9.0,
}
LETTERS_PER_IN = 10.5  # in a title
LINE_IN = 0.19  # line height in titles and legends [inch]
# margins around a panel of a fixed size [inch]; left: ticks and label of y
LEFT_IN = 0.85
RIGHT_IN = 0.2
BELOW_IN = 0.55  # ticks and label of x
ABOVE_IN = 0.14  # between the title and the panel
TITLE_LINES = 2  # minimum number of lines reserved above a panel of a fixed size
LegendPlace = Literal["outside upper center", "upper center"]


class Panel(NamedTuple):
    """Size of axes without the text around them [inch]."""

    width: float
    height: float
    left: float = LEFT_IN  # room for the ticks and the label of y


@contextmanager
def apply_style() -> Iterator[None]:
    """Applies the style to everything drawn in a block, or in a decorated function."""
    with mpl.rc_context(RC):
        yield


@apply_style()
def make_panels(
    rows: int, columns: int, size: tuple[float, float] | None = None, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Returns a figure of a size [inch] and its axes, row by row.

    Without a size, `render_png` sizes it to fit its panels.
    """
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(
        figure.subplots(rows, columns, squeeze=False, **options).ravel()
    )


def _compute_width(panel: Panel, columns: int = 1) -> float:
    """Returns the width [inch] of a figure whose panels have a fixed size."""
    return columns * (panel.left + panel.width + RIGHT_IN)


@apply_style()
def render_png(
    figure: Figure, legend: Axes | None = None, panel: Panel | None = None
) -> bytes:
    """Renders a figure as a PNG, with empty axes hidden and the legend of one of the axes on top.

    Titles are wrapped to the width of their axes.

    Args:
        figure: the figure.
        legend: axes whose legend is shown.
        panel: size of each of the axes in a grid [inch], without the text around them; determines
            the size of the figure. By default the axes fill the figure.
    """
    if panel is not None:
        _, columns = _count_grid(figure)
        figure.set_layout_engine(None)
        figure.set_figwidth(_compute_width(panel, columns))
    for axes in figure.axes:
        if not axes.has_data():
            axes.set_axis_off()
        frame_legend = axes.get_legend()
        if frame_legend is not None:
            frame_legend.set_frame_on(False)
        _wrap_title(axes, figure.get_figwidth())
    rows = 0
    if legend is not None:
        # Without a panel, the axes make room for the legend.
        place: LegendPlace = "outside upper center"
        rows = _add_legend(figure, legend, "upper center" if panel else place)
    if panel is not None:
        _place_panels(figure, panel, rows)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _wrap_title(axes: Axes, width: float) -> None:
    """Wraps the title of axes in a grid of a width [inch]."""
    place = axes.get_subplotspec()
    if place is not None:
        fraction = len(place.colspan) / place.get_gridspec().ncols
        letters = int(LETTERS_PER_IN * fraction * width)
        lines = (fill(line, letters) for line in axes.get_title().splitlines())
        axes.set_title("\n".join(lines))


def _add_legend(figure: Figure, source: Axes, place: LegendPlace) -> int:
    """Adds the legend of one of the axes to the figure; returns its number of rows."""
    handles, labels = source.get_legend_handles_labels()
    if not labels:
        return 0
    columns = len(labels)
    letters = LETTERS_PER_IN * figure.get_figwidth()
    widths = [len(label) + 5 for label in labels]
    if sum(widths) > letters:
        columns = max(1, int(letters / max(widths)))
    figure.legend(handles, labels, loc=place, ncols=columns)
    return -(-len(labels) // columns)


def _count_grid(figure: Figure) -> tuple[int, int]:
    """Returns the numbers of rows and columns of a figure's grid."""
    cells = [axes.get_subplotspec() for axes in figure.axes]
    (grid,) = {cell.get_gridspec() for cell in cells if cell is not None}
    rows, columns = grid.get_geometry()
    return rows, columns


def _place_panels(figure: Figure, panel: Panel, rows_of_legend: int) -> None:
    """Gives a figure its size, and each of its axes the size of a panel [inch]."""
    rows, columns = _count_grid(figure)
    lines = [len(axes.get_title().splitlines()) for axes in figure.axes]
    above = ABOVE_IN + LINE_IN * max(TITLE_LINES, *lines)
    legend = LINE_IN * (rows_of_legend + 0.5)
    width = _compute_width(panel, columns)
    height = legend + rows * (above + panel.height + BELOW_IN)
    figure.set_size_inches(width, height)
    figure.subplots_adjust(
        left=panel.left / width,
        right=1.0 - RIGHT_IN / width,
        bottom=BELOW_IN / height,
        top=1.0 - (legend + above) / height,
        wspace=(panel.left + RIGHT_IN) / panel.width,
        hspace=(above + BELOW_IN) / panel.height,
    )
