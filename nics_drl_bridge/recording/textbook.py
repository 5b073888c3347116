"""Drives of textbook robots, the source of synthetic recordings; see `robot.kinds`."""

import numpy as np

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.heading import chain_poses
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.kinds import Textbook, textbook
from nics_drl_bridge.robot.spec import RobotSpec

INTEGRATION_STEP_S = 1e-3
ROW_S = 0.01  # between two rows of a recording
HOLD_S = 0.5  # duration of a command


def _integrate_substep(
    book: Textbook, state: Array, goal: Array, since: Array | float, h: float
) -> Array:
    """Returns body twist x duration (..., 3) of a substep that begins `since` [s] after `state`."""
    # Fourth-order Magnus expansion (Iserles, Norsett 1999).
    early, late = (
        book.twist(
            book.respond(state, goal, since + (0.5 + sign * np.sqrt(3.0) / 6.0) * h)
        )
        for sign in (-1.0, 1.0)
    )
    wa = early[..., 2]
    wb = late[..., 2]
    bx = wb * early[..., 1] - wa * late[..., 1]
    by = wa * late[..., 0] - wb * early[..., 0]
    bracket = np.stack([bx, by, np.zeros_like(wa)], axis=-1)
    return np.asarray(
        (early + late) * (h / 2.0) + bracket * (np.sqrt(3.0) / 12.0 * h * h)
    )


def record(
    spec: RobotSpec,
    rng: np.random.Generator,
    duration: float = defaults.DRIVE_S,
    dt: float = ROW_S,
    hold: float = HOLD_S,
) -> Recording:
    """Records a textbook robot without noise; commands last `hold`, rows are `dt` apart [s]."""
    book = textbook(spec)
    inner = max(1, int(np.ceil(dt / INTEGRATION_STEP_S - 1e-9)))
    h = dt / inner
    per_hold = round(hold / dt)
    holds = int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    since = h * np.arange(per_hold * inner, dtype=np.float64)[:, None]
    now = np.zeros(len(book.lag))
    states = []
    arcs = []
    for goal in book.target(held):
        states.append(book.respond(now, goal, since))
        arcs.append(_integrate_substep(book, now, goal, since, h))
        now = book.respond(now, goal, per_hold * inner * h)
    state = np.concatenate(states)[::inner]
    pose = chain_poses(np.zeros(3), geometry.exp(np.concatenate(arcs)))[:-1:inner]
    t = np.asarray(np.arange(holds * per_hold) * dt, dtype=np.float64)
    return Recording(
        Stream(t, np.repeat(held, per_hold, axis=0)),
        Stream(t, pose),
        Stream(t, state) if spec.state else None,
        source=f"textbook {spec.name}",
        variables=spec.variable_names,
        measured_by="truth",
    )
