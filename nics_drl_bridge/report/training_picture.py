"""The picture of a training: how often its episodes succeed, as it goes on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from nics_drl_bridge.report.drawing import MEASURED, MODEL, png


@dataclass(frozen=True)
class Point:
    """Where a training stood.

    Attributes:
        steps: environment steps done.
        success, collision: shares of the last 1000 episodes; NaN before the first has ended.
    """

    steps: int
    success: float
    collision: float


def training_curve(points: Sequence[Point]) -> bytes:
    """Success and collisions [%] over the environment steps, as a PNG."""
    figure = Figure(figsize=(7.5, 3.8), layout="constrained")
    axes = figure.subplots()
    steps = [point.steps / 1e3 for point in points]
    for name, color in (("success", MEASURED), ("collision", MODEL)):
        shares = [100.0 * getattr(point, name) for point in points]
        axes.plot(steps, shares, color=color, linewidth=2.0, label=name)
    axes.set_xlabel("environment steps [thousands]")
    axes.set_ylabel("of the last 1000 episodes [%]")
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return png(figure)
