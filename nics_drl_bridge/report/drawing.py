"""What all pictures of a fit share: colours and the way to a PNG."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

MEASURED, MODEL, OTHER, DARK = "#1f6fb2", "#d1495b", "#8d99ae", "#333333"


def png(figure: Figure) -> bytes:
    """The figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
