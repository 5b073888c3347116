"""One style of all pictures: type, and colours of Okabe and Ito, which every eye tells apart."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from textwrap import fill
from typing import Any

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
MARKERS = (
    "o",
    "s",
    "^",
    "D",
    "v",
    "P",
    "X",
)  # of `SERIES`, as told apart without colours
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
LETTERS_PER_IN = 10.5  # of a title


@contextmanager
def styled() -> Iterator[None]:
    """Gives what is drawn inside the style; of a function as a decorator, too."""
    with mpl.rc_context(RC):
        yield


@styled()
def panels(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, list[Axes]]:
    """Returns a figure of a size [inch], and its axes in rows."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(
        figure.subplots(rows, columns, squeeze=False, **options).ravel()
    )


@styled()
def png(figure: Figure, legend: Axes | None = None) -> bytes:
    """Renders a figure as a PNG, without empty axes, with the legend of one of them above.

    Titles are broken into lines that fit above their axes.
    """
    for axes in figure.axes:
        if not axes.has_data():
            axes.set_axis_off()
        if (own := axes.get_legend()) is not None:
            own.set_frame_on(False)
        if (cell := axes.get_subplotspec()) is not None:
            share = len(cell.colspan) / cell.get_gridspec().ncols
            letters = int(LETTERS_PER_IN * share * figure.get_figwidth())
            title = (fill(line, letters) for line in axes.get_title().splitlines())
            axes.set_title("\n".join(title))
    if legend is not None:
        handles, labels = legend.get_legend_handles_labels()
        room = LETTERS_PER_IN * figure.get_figwidth()
        each = [len(label) + 5 for label in labels]
        columns = len(labels) if sum(each) <= room else max(1, int(room / max(each)))
        figure.legend(handles, labels, loc="outside upper center", ncols=columns)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
