"""Input curves: what motors make of commands, a dead zone and saturation (Hammerstein models)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec

LAGS_S = (0.05, 0.15, 0.4, 1.0, 2.0)
DEAD = np.linspace(0.0, 0.45, 10)  # shares of the command's reach
FULL = np.linspace(0.15, 1.0, 18)
WORTH = 0.03  # a curve takes at least this share of what is left without it
CLEAR = 0.25  # one of the turn rate this, as understeer looks alike; then it is beyond doubt
STRIDE_S = 0.04


@dataclass(frozen=True)
class Candidate:
    """A curve that explains a component of the twist better than none."""

    curve: InputCurve
    gain: float  # share of the unexplained variance that it explains
    drives: bool  # True if of the speed

    @property
    def is_clear(self) -> bool:
        """True if it is beyond doubt."""
        return self.gain >= CLEAR


def curve_of(samples: Samples, spec: RobotSpec, place: int) -> Candidate | None:
    """Returns the best curve of the command at a place; None if a straight line does as well."""
    twists = [POSE_RATES.index(v.twist) for v in spec.state if v.twist]
    found = [f for dof in twists if (f := _of_component(samples, spec, place, dof)) is not None]
    best = max(found, key=lambda each: each.gain, default=None)
    return best if best and best.gain >= (WORTH if best.drives else CLEAR) else None


def _of_component(samples: Samples, spec: RobotSpec, place: int, dof: int) -> Candidate | None:
    states = len(spec.state)
    command = samples.x[:, states:]
    twist = {v.twist: samples.x[:, i] for i, v in enumerate(spec.state) if v.twist}
    target, speed = twist[POSE_RATES[dof]], twist.get("vx", np.zeros(len(samples.t)))
    stride = max(1, round(STRIDE_S / samples.dt))
    reach = np.array([command[:, place].min(), command[:, place].max()])

    def left(dead: float, full: float) -> float:
        curve = _curve("", reach, dead, full)
        least = np.inf
        for lag in LAGS_S:
            columns = [np.ones(len(target))]
            for c in range(command.shape[1]):
                u = curve.of(command[:, c]) if c == place else command[:, c]
                share = 1.0 - np.exp(-samples.dt / lag)
                low = lfilter([share], [1.0, share - 1.0], u)
                columns += [low] if dof == 0 else [low, low * speed]
            chi = np.stack(columns, axis=1)[::stride]
            rest = target[::stride] - chi @ np.linalg.lstsq(chi, target[::stride], rcond=None)[0]
            least = min(least, float(rest @ rest))
        return least

    plain = left(0.0, 1.0)
    tries = [(left(0.0, full), 0.0, full) for full in FULL]
    full = min(tries)[2]
    tries += [(left(dead, full), dead, full) for dead in DEAD if dead < full]
    least, dead, full = min(tries)
    gain = 1.0 - least / max(plain, 1e-300)
    if gain < WORTH:
        return None
    return Candidate(_curve(spec.command[place].name, reach, dead, full), gain, dof == 0)


def _curve(name: str, reach: Array, dead: float, full: float) -> InputCurve:
    size = float(np.abs(reach).max())
    return InputCurve(
        command=name, dead=dead * size, least=max(float(reach[0]), -full * size),
        most=min(float(reach[1]), full * size),
    )  # fmt: skip
