"""The report as one self-contained HTML file; colours and PNG export of its pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

MEASURED, MODEL, OTHER, DARK = "#1f6fb2", "#d1495b", "#8d99ae", "#333333"
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 64rem;
  padding: 0 1rem; color: #222; background: #fff }
h1 { margin-bottom: 0 } h2 { margin-top: 2.2rem; border-bottom: 1px solid #ddd }
table { border-collapse: collapse; margin: 1rem 0 }
th, td { padding: .3rem .9rem; text-align: right;
  border-bottom: 1px solid #e5e5e5 } th:first-child, td:first-child { text-align: left }
pre { background: #f6f7f9; padding: 1rem; overflow-x: auto; font-size: 14px }
img { max-width: 100% }
.lead { color: #555; font-size: 1.1rem }
"""


def page(title: str, lead: str, sections: Sequence[tuple[str, Sequence[str]]]) -> str:
    """Builds an HTML page of sections, each a heading and HTML blocks, below a lead sentence."""
    body = "".join(f"<h2>{escape(heading)}</h2>{''.join(blocks)}" for heading, blocks in sections)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body><h1>{escape(title)}</h1>"
        f'<p class="lead">{escape(lead)}</p>{body}</body></html>\n'
    )


def paragraph(text: str) -> str:
    """Returns a paragraph as HTML, as the next three."""
    return f"<p>{escape(text)}</p>"


def code(text: str) -> str:
    """Preformatted text."""
    return f"<pre>{escape(text)}</pre>"


def picture(png: bytes, caption: str) -> str:
    """A PNG with its caption."""
    data, caption = base64.b64encode(png).decode(), escape(caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows of text under a heading row."""

    def cells(kind: str, row: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row) + "</tr>"

    body = "".join(cells("td", row) for row in rows)
    return f"<table><thead>{cells('th', head)}</thead><tbody>{body}</tbody></table>"


def panels(
    rows: int, columns: int, size: tuple[float, float], **options: Any
) -> tuple[Figure, list[Axes]]:
    """Returns a figure of a size [inch], and its axes in rows."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **options).ravel())


def png(figure: Figure, legend: Axes | None = None) -> bytes:
    """Renders a figure as a PNG, without empty axes, with the legend of one of them above."""
    for axes in figure.axes:
        if not axes.has_data():
            axes.set_axis_off()
    if legend is not None:
        handles, labels = legend.get_legend_handles_labels()
        columns = max(3, len(labels))
        figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
