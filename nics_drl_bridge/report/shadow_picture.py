"""A picture of a policy in the shadow of a drive."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

from nics_drl_bridge.policy.shadow import Shadow

DRIVEN, POLICY, GAP = "#1f6fb2", "#d1495b", "#777777"


def shadow_picture(shadow: Shadow) -> bytes:
    """Each command over time, as it was driven and as the policy would have it.

    Args:
        shadow: the policy beside the drive.

    Returns:
        A PNG.
    """
    count = len(shadow.names)
    figure = Figure(figsize=(11.0, 2.4 * count + 0.6), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False, width_ratios=(4.0, 1.0))
    for c, (wide, narrow) in enumerate(grid):
        driven, wanted = shadow.driven[:, c], shadow.policy[:, c]
        wide.step(shadow.time, driven, where="post", color=DRIVEN, linewidth=1.6, label="driven")
        wide.step(shadow.time, wanted, where="post", color=POLICY, linewidth=1.0, label="policy")
        wide.set_ylabel(f"{shadow.names[c]} [{shadow.units[c]}]")
        narrow.hist(wanted - driven, bins=31, color=GAP)
        narrow.set_xlabel(f"policy less driven [{shadow.units[c]}]")
    grid[-1][0].set_xlabel("time [s]")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
