"""Compiled rollout of the yardstick: first-order twists, or a bicycle, over windows."""

import math
from typing import NamedTuple

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel


class BicycleGeometry(NamedTuple):
    """Geometry of a robot that steers."""

    used: bool
    front_drive: bool
    wheelbase: float  # [m]
    understeer: float  # turn rates are divided by 1 + understeer * speed^2 [s^2/m^2]


STRAIGHT = BicycleGeometry(False, False, 1.0, 0.0)


@kernel
def _limited(value: float, target: float, lag: float, limit: Array) -> float:
    """Returns a target close enough that a first-order lag towards it stays within `limit` (2,)."""
    gap = target - value
    most: float = lag * (limit[0] if gap * value >= 0.0 else limit[1])
    return value + most * math.tanh(gap / most)


@kernel
def _twist(state: Array, bicycle: BicycleGeometry) -> tuple[float, float, float]:
    if not bicycle.used:
        return state[0], state[1], state[2]
    speed = state[0]
    angle = state[2]
    if bicycle.front_drive:
        return speed * math.cos(angle), 0.0, speed * math.sin(angle) / bicycle.wheelbase
    length = bicycle.wheelbase * (1.0 + bicycle.understeer * speed * speed)
    return speed, 0.0, speed * math.tan(angle) / length


@kernel
def roll_windows(
    ends: Array,
    actuator: Array,
    begin: Array,
    stops: Array,
    target: Array,
    lag: Array,
    limit: Array,
    bicycle: BicycleGeometry,
    dt: float,
) -> None:
    """Writes relative poses (W, H, 3) at ascending `stops` (W, H), in steps of `dt` after `begin`.

    `actuator` (W, 3) holds the initial states and is overwritten: a body twist, or speed, 0 and
    angle of a steered robot; `target` (G, 3) their targets on a grid, `begin` (W,) indices in it;
    `lag` (3,) [s]; `limit` (2,) of the speed's acceleration and deceleration [m/s^2].
    """
    for w in range(len(begin)):
        x = 0.0
        y = 0.0
        heading = 0.0
        done = 0.0
        state = actuator[w]
        for h in range(stops.shape[1]):
            while done < stops[w, h] - 1e-9:
                share = min(1.0, stops[w, h] - done)
                place = min(max(begin[w] + done, 0.0), len(target) - 2.0)
                k = int(place)
                for i in range(3):
                    aim = target[k, i] + (place - k) * (target[k + 1, i] - target[k, i])
                    if i == 0:
                        aim = _limited(state[0], aim, lag[0], limit)
                    state[i] = aim + (state[i] - aim) / (1.0 + share * dt / lag[i])
                vx, vy, turn = _twist(state, bicycle)
                span = share * dt
                middle = heading + 0.5 * turn * span
                c = math.cos(middle)
                s = math.sin(middle)
                x += span * (c * vx - s * vy)
                y += span * (s * vx + c * vy)
                heading += turn * span
                done += share
            ends[w, h, 0] = x
            ends[w, h, 1] = y
            ends[w, h, 2] = heading
