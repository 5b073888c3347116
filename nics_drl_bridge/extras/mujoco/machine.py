"""Common parts of the three machines: mass, friction, motors, and their MJCF.

MuJoCo solves the contact of each wheel with the floor; nothing ties the robot to its textbook
kinematics. Tyres are ellipsoids: a round tread touches a plane in one point, which neither jumps
from edge to edge, as a cylinder's contact does, nor scrubs when the robot turns. Contacts have no
torsional friction, and nothing is dragged over the floor: with MuJoCo's elliptic cones a contact
that slides for long pushes itself off the floor and chatters.

The only module that imports MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError

Array = NDArray[np.float64]

TORQUE_RESERVE = 1.5
"""Torque limit of a motor, as a multiple of the torque for the maximum acceleration."""

SERVO_LAG_S = 0.005
"""Lag of a motor behind its set point."""


@dataclass(frozen=True)
class Physics:
    """Parameters of a machine that a RobotSpec does not have; the mass is that of a small robot.

    Attributes:
        timestep: of MuJoCo [s].
        mass: of the chassis with its load, without wheels [kg].
        wheel_mass: of a wheel [kg].
        friction: between tyre and floor.
        acceleration: of the robot after the maximum step of a command [m/s^2].
        softness: time constant with which a tyre pressed into the floor springs back [s].
        bearing: viscous friction of wheels that are not driven, and of rollers [N m s/rad].
        rollers: number of rollers per mecanum wheel.
    """

    timestep: float = 0.001
    mass: float = 4.0
    wheel_mass: float = 0.15
    friction: float = 1.0
    acceleration: float = 5.0
    softness: float = 0.005
    bearing: float = 1e-6
    rollers: int = 12


@dataclass(frozen=True)
class Machine:
    """A robot in MuJoCo's form. Symbols: S state, U actuators, J joints.

    Attributes:
        xml: the MJCF model; its body `base_link` has the only free joint.
        height: of `base_link` above the floor when the robot stands [m].
        joints: J names of the joints with encoders.
        controls: maps a wanted state (S,) to the actuators' inputs (U,).
        state: maps positions (J,) [rad] and speeds (J,) [rad/s] of the joints to the state (S,).
    """

    xml: str
    height: float
    joints: tuple[str, ...]
    controls: Callable[[Array], Array]
    state: Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Motor:
    """A motor under a velocity servo: torque = gain x (wanted - actual speed), up to a limit.

    The wanted speed follows the command with a first-order lag, like the set point of a motor
    controller, so that the servo is stiff and keeps its speed under load.

    Attributes:
        gain: [N m s/rad].
        torque: limit [N m].
        lag: of the set point [s].
    """

    gain: float
    torque: float
    lag: float

    def mjcf(self, transmission: str) -> str:
        """The MJCF of the motor at a `joint="NAME"` or a `tendon="NAME"`."""
        return f"""
    <general {transmission} dyntype="filterexact" dynprm="{self.lag:.8g}" gainprm="{self.gain:.8g}"
             biastype="affine" biasprm="0 0 {-self.gain:.8g}"
             forcerange="{-self.torque:.8g} {self.torque:.8g}"/>"""


def motor(inertia: float, lag: float, radius: float, step: float, physics: Physics) -> Motor:
    """Motor that makes a wheel follow its target with a lag, within the limits of friction.

    Spinning or locked wheels do not steer, so the lag is longer than requested if the maximum step
    of the command would accelerate the robot by more than `physics.acceleration`.

    Args:
        inertia: at the motor's shaft, including the share of the moving robot [kg m^2].
        lag: time constant [s].
        radius: of the wheel [m].
        step: maximum step of the commanded speed [m/s].
        physics: of the machine.
    """
    lag = max(lag, step / physics.acceleration)
    limit = TORQUE_RESERVE * physics.acceleration
    return Motor(inertia / SERVO_LAG_S, inertia * limit / radius, lag - SERVO_LAG_S)


def document(name: str, physics: Physics, height: float, robot: str, actuators: str) -> str:
    """Builds the MJCF of a robot on an infinite floor.

    Args:
        name: of the model.
        physics: gives step and friction.
        height: of `base_link` above the floor [m].
        robot: MJCF of the contents of the body `base_link`.
        actuators: MJCF from `</worldbody>` on.
    """
    return f"""
<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{physics.timestep}" integrator="implicitfast" cone="elliptic"
          jacobian="sparse"/>
  <default>
    <geom contype="0" conaffinity="0" condim="3" friction="{physics.friction}"/>
    <default class="tread">
      <geom contype="1" priority="1" solref="{physics.softness} 1"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" conaffinity="1"/>
    <body name="base_link" pos="0 0 {height}">
      <freejoint/>{robot}
    </body>
  </worldbody>
{actuators}
</mujoco>
"""


def chassis(mass: float, centre: tuple[float, float, float], size: tuple[float, ...]) -> str:
    """MJCF of a box: mass [kg], centre in `base_link` [m], full size [m]."""
    half = " ".join(f"{0.5 * s:.6g}" for s in size)
    x, y, z = centre
    return f"""
      <geom name="chassis" type="box" mass="{mass}" pos="{x:.6g} {y:.6g} {z:.6g}" size="{half}"/>"""


def wheel(name: str, radius: float, width: float, physics: Physics, damping: float = 0.0) -> str:
    """MJCF inside a wheel's body: a hinge about y, a hub with the mass, a round tread."""
    return f"""
        <joint name="{name}" axis="0 1 0" damping="{damping}"/>
        <geom type="cylinder" mass="{physics.wheel_mass}" size="{radius:.6g} {0.5 * width:.6g}"
              zaxis="0 1 0"/>
        <geom class="tread" type="ellipsoid" mass="0" zaxis="0 1 0"
              size="{radius:.6g} {radius:.6g} {0.5 * width:.6g}"/>"""


def load_mujoco() -> Any:
    """Returns the module `mujoco`.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise ConfigError(
            "MuJoCo is not installed; run pip install 'nics_drl_bridge[mujoco]'."
        ) from None
    return mujoco
