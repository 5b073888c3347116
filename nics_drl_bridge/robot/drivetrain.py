"""Drive trains of which textbook kinematics are made: wheels on a base, and a steered axle.

Commands are identified by their field of `cmd_vel`, speed and steering angle in the state by their
units. An actuator is of first order (parameters `wheel_lag`, `speed_lag`, `steering_lag` [s]) or
rate-limited (`wheel_rate`, `speed_rate`, `steering_rate` [its unit/s]). Siegwart, Nourbakhsh,
Scaramuzza: Introduction to Autonomous Mobile Robots, ch. 3; the paper's reference for Table I.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import Textbook
from nics_drl_bridge.robot.spec import POSE_RATES, CmdVelField, RobotSpec, StateVariable

Array = NDArray[np.float64]


def steered(spec: RobotSpec, twist: Callable[[Array, Array], Array]) -> Textbook:
    """Builds the kinematics of a robot that is driven by a speed and a steering angle.

    Both are its state and its commands, in any order; its turn rate is, to second order, a multiple
    of their product. `twist` is (..., 3) for speeds [m/s] and angles [rad] (...).
    """
    v, phi = _states(spec)
    command, order = _commands(spec, ("linear.x", "angular.z")), np.argsort([v, phi])
    names = [spec.state[i].name for i in (v, phi)]
    lag, rate = _actuators(spec.parameters, ("speed", "steering"))
    return Textbook(
        twist=lambda state: twist(state[..., v], state[..., phi]),
        target=lambda given: given[..., command][..., order], lag=lag[order], rate=rate[order],
        structure={"vx": (names[0],), "vy": (), "wz": ("*".join(names),)},
    )  # fmt: skip


def steering_angle(spec: RobotSpec) -> StateVariable:
    """Returns the state variable of the steering angle of a robot that is `steered`."""
    return spec.state[_states(spec)[1]]


def wheeled(
    spec: RobotSpec, inverse: Array, forward: Array, fields: tuple[CmdVelField, ...],
    moves: tuple[str, ...],
) -> Textbook:  # fmt: skip
    """Builds the kinematics of a robot whose twist is linear in its wheel speeds, its state.

    `inverse` (S, C) gives wheel speeds per command, in the order of `fields`; `forward` (3, S) the
    body twist per wheel speed. The wheels can move the degrees of freedom `moves`.
    """
    if len(spec.state) != len(inverse):
        needed = f"have {len(inverse)} wheels as state, not {len(spec.state)} variables"
        raise _unfit(spec, f"{needed}; correct `state:`.")
    command = _commands(spec, fields)
    names = tuple(v.name for v in spec.state)
    lag, rate = _actuators(spec.parameters, ("wheel",) * len(inverse))
    return Textbook(
        twist=lambda state: state @ forward.T, target=lambda given: given[..., command] @ inverse.T,
        lag=lag, rate=rate, structure={dof: names if dof in moves else () for dof in POSE_RATES},
    )  # fmt: skip


def _commands(spec: RobotSpec, fields: tuple[CmdVelField, ...]) -> list[int]:
    have = [c.cmd_vel for c in spec.command]
    if not any(have):
        return list(range(len(have)))
    for field in fields:
        if field not in have:
            raise _unfit(spec, f"need a command with `cmd_vel: {field}`; add it.")
    return [have.index(field) for field in fields]


def _unfit(spec: RobotSpec, reason: str) -> ConfigError:
    return ConfigError(f"robot {spec.name!r}: the {spec.textbook} kinematics {reason}")


def _states(spec: RobotSpec) -> tuple[int, int]:
    have = [v.unit for v in spec.state]
    if sorted(have) != ["m/s", "rad"]:
        given = ", ".join(have) or "nothing"
        raise _unfit(spec, f"need a state in m/s and rad, not in {given}; correct `state:`.")
    return have.index("m/s"), have.index("rad")


def _actuators(p: dict[str, float], parts: tuple[str, ...]) -> tuple[Array, Array]:
    rate = np.array([p.get(f"{part}_rate", np.inf) for part in parts])
    lag = [p[f"{part}_lag"] if f"{part}_rate" not in p else 1.0 for part in parts]
    return np.array(lag), rate
