"""Drive trains of which textbook kinematics are made: wheels on a base, and a steered axle.

Commands are identified by their field of `cmd_vel`, without any by their name, else by their place;
speed and steering angle in the state by their units. An actuator is of first order (parameters
`wheel_lag`, `speed_lag`, `steering_lag` [s]) or rate-limited (`wheel_rate`, `speed_rate`,
`steering_rate` [its unit/s]). Siegwart, Nourbakhsh, Scaramuzza: Introduction to Autonomous Mobile
Robots, ch. 3; the paper's reference for Table I.
"""

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import Textbook
from nics_drl_bridge.robot.spec import (
    CMD_VEL_FIELDS,
    POSE_RATES,
    CmdVelField,
    RobotSpec,
    StateVariable,
)
from nics_drl_bridge.robot.steering import Bicycle

Array = NDArray[np.float64]


def steered(
    spec: RobotSpec, geometry: Bicycle, names: tuple[str, ...], gain: tuple[float, float] = (1, 1)
) -> Textbook:
    """Builds the kinematics of a robot that is driven by a speed and a steering angle.

    Both are its actuators, and the `gain` times its commands, in any order; its turn rate is, to
    second order, a multiple of their product. `names` are usual ones of the commands.
    """
    v, phi = _states(spec)
    command = _commands(spec, ("linear.x", "angular.z"), names, 2)
    order = np.argsort([v, phi])
    speed, angle = (spec.state[i].name if _own_state(spec) else names[i] for i in (v, phi))
    lag, rate = _actuators(spec.parameters, ("speed", "steering"))
    return Textbook(
        twist=lambda state: geometry.twist(state[..., v], state[..., phi]),
        target=lambda given: (given[..., command] * gain)[..., order],
        lag=lag[order], rate=rate[order],
        structure={"vx": (speed,), "vy": (), "wz": (f"{speed}*{angle}",)},
        command=lambda twist: _placed(
            spec, command, np.stack(geometry.command(twist), axis=-1) / gain
        ),
    )  # fmt: skip


def steering_angle(spec: RobotSpec) -> StateVariable | None:
    """Returns the state variable of the steering angle of a robot that is `steered`, if any."""
    return spec.state[_states(spec)[1]] if _own_state(spec) else None


def wheeled(
    spec: RobotSpec, inverse: Array, forward: Array, moves: tuple[str, ...],
    wheels: tuple[str, ...], slip: float = 1.0,
) -> Textbook:  # fmt: skip
    """Builds the kinematics of a robot whose twist is linear in its wheel speeds, its actuators.

    `inverse` (W, M) gives wheel speeds per component of the twist that the wheels can move, by name
    in `moves`; `forward` (3, W) the body twist per wheel speed, whose turn rate slips by a factor.
    It is commanded by its twist, else by its wheel speeds, with the usual names `wheels`.
    """
    if _own_state(spec) and len(spec.state) != len(inverse):
        needed = f"have {len(inverse)} wheels as state, not {len(spec.state)} variables"
        raise _unfit(spec, f"{needed}; correct `state:`.")
    dofs = [POSE_RATES.index(dof) for dof in moves]
    fields = tuple(CMD_VEL_FIELDS[dof] for dof in dofs)
    by_wheels = all(c.unit == "rad/s" and c.cmd_vel is None for c in spec.command)
    into = np.eye(len(inverse)) if by_wheels else inverse
    command = _commands(spec, fields, wheels if by_wheels else (), into.shape[1])
    undone = inverse if by_wheels else np.eye(len(dofs))
    slipping = np.array([1.0, 1.0, slip])
    out = forward * slipping[:, None]
    names = tuple(v.name for v in spec.state) if _own_state(spec) else wheels
    lag, rate = _actuators(spec.parameters, ("wheel",) * len(inverse))
    return Textbook(
        twist=lambda state: state @ out.T, target=lambda given: given[..., command] @ into.T,
        lag=lag, rate=rate, structure={dof: names if dof in moves else () for dof in POSE_RATES},
        command=lambda twist: _placed(spec, command, (twist / slipping)[..., dofs] @ undone.T),
    )  # fmt: skip


def _own_state(spec: RobotSpec) -> bool:
    """True if the state consists of actuators."""
    return any(v.twist is None for v in spec.state)


def _commands(
    spec: RobotSpec, fields: tuple[CmdVelField, ...], names: tuple[str, ...], count: int
) -> list[int]:
    have = [c.cmd_vel for c in spec.command]
    if not any(have):
        if len(have) != count:
            raise _unfit(spec, f"need {count} commands, not {len(have)}; correct `command:`.")
        called = [c.name for c in spec.command]
        if names and set(names) == set(called):
            return [called.index(name) for name in names]
        return list(range(len(have)))
    for field in fields:
        if field not in have:
            raise _unfit(spec, f"need a command with `cmd_vel: {field}`; add it.")
    return [have.index(field) for field in fields]


def _placed(spec: RobotSpec, places: list[int], values: Array) -> Array:
    """Returns commands (..., C) with values at places, else 0."""
    command = np.zeros((*values.shape[:-1], len(spec.command)))
    command[..., places] = values
    return command


def _unfit(spec: RobotSpec, reason: str) -> ConfigError:
    return ConfigError(f"robot {spec.name!r}: the {spec.textbook} kinematics {reason}")


def _states(spec: RobotSpec) -> tuple[int, int]:
    if not _own_state(spec):
        return 0, 1
    have = [v.unit for v in spec.state]
    if sorted(have) != ["m/s", "rad"]:
        given = ", ".join(have) or "nothing"
        raise _unfit(spec, f"need a state in m/s and rad, not in {given}; correct `state:`.")
    return have.index("m/s"), have.index("rad")


def _actuators(p: dict[str, float], parts: tuple[str, ...]) -> tuple[Array, Array]:
    rate = np.array([p.get(f"{part}_rate", np.inf) for part in parts])
    lag = [p[f"{part}_lag"] if f"{part}_rate" not in p else 1.0 for part in parts]
    return np.array(lag), rate
