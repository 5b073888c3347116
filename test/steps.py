"""Motion of textbook robots from given states, by the arcs that make a textbook recording."""

from __future__ import annotations

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.textbook import INTEGRATION_STEP_S, _integrate_substep
from nics_drl_bridge.robot.kinds import Textbook


def integrate(
    book: Textbook, pose: Array, state: Array, command: Array, dt: float
) -> tuple[Array, Array]:
    """Moves robots with poses (..., 3) and states (..., S) under constant commands (..., C).

    For `dt` [s]; returns pose and state. The state is exact. The pose follows arcs of at most 1 ms
    by the Magnus expansion of fourth order (Iserles, Norsett 1999): its error is below 1e-11 m even
    over seconds.
    """
    steps = max(1, int(np.ceil(dt / INTEGRATION_STEP_S - 1e-9)))
    h = dt / steps
    goal = book.target(command)
    for k in range(steps):
        pose = geometry.compose(
            pose, geometry.exp(_integrate_substep(book, state, goal, k * h, h))
        )
    return pose, book.respond(state, goal, dt)
