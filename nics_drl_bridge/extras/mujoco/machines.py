"""Robots as MJCF for MuJoCo; tyres are ellipsoids, which neither jump nor scrub."""

import numpy as np
from numpy.polynomial import polynomial

from nics_drl_bridge.extras.physics.machines import (
    ROLLER_MASS,
    STEERING_TORQUE,
    Machine,
    Physics,
    Wheel,
    place_rollers,
)

# torque limit of a motor, relative to the torque of the maximum acceleration
TORQUE_RESERVE = 1.5
# inertia of a geared motor, relative to the robot's inertia per driven wheel
ROTOR = 0.25
SERVO_LAG_S = 0.005  # lag of a motor behind its set point
# the same for a motor that must keep its speed while its tyres are dragged sideways
STIFF_SERVO_LAG_S = 0.001
# MuJoCo's `impratio`: stiffness of tyres against skidding relative to that against compression.
# At 1, MuJoCo's convex contacts lift sliding wheels so far that they hop off the floor.
SKIDDING = 0.01
STEERING_STIFFNESS = 1.0  # torque of a steering servo per error [N m/rad]
MISFIT = 0.01  # maximum error of a wheel's angle due to the tie rod [rad]


def write_mjcf(machine: Machine, physics: Physics) -> str:
    """Returns the MJCF of a machine; its body `base_link` has the only free joint."""
    skids = machine.kind == "skid_steer"
    half = " ".join(f"{0.5 * s:.6g}" for s in machine.size)
    centre = " ".join(f"{c:.6g}" for c in machine.centre)
    robot = f"""
      <geom name="chassis" type="box" mass="{physics.mass}" pos="{centre}" size="{half}"/>"""
    if machine.castor is not None:
        behind, ball = machine.castor
        robot += f"""
      <body pos="{behind:.6g} 0 {ball - machine.radius:.6g}">
        <joint type="ball" damping="{physics.bearing}"/>
        <geom class="tread" type="sphere" size="{ball:.6g}" mass="0.03"/>
      </body>"""
    robot += "".join(_write_wheel(wheel, machine, physics) for wheel in machine.wheels)
    if machine.kind == "ackermann":
        actuators = _write_car_actuators(machine, physics) + _write_tie_rod(machine)
    else:
        servo_lag = STIFF_SERVO_LAG_S if skids else SERVO_LAG_S
        rows = "".join(
            _write_motor(f'joint="{name}"', machine, physics, servo_lag)
            for name in machine.joints
        )
        actuators = f"""
  <actuator>{rows}
  </actuator>"""
    return f"""
<mujoco model="{machine.kind}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{physics.timestep}" integrator="implicitfast" cone="elliptic"
          jacobian="sparse" impratio="{SKIDDING if skids else 1.0:g}"/>
  <default>
    <geom contype="0" conaffinity="0" condim="3" friction="{physics.friction}"/>
    <default class="tread">
      <geom contype="1" priority="1" solref="{physics.softness} 1"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" conaffinity="1"/>
    <body name="base_link" pos="0 0 {machine.radius}">
      <freejoint/>{robot}
    </body>
  </worldbody>
{actuators}
</mujoco>
"""


def _write_wheel(wheel: Wheel, machine: Machine, physics: Physics) -> str:
    x, y = wheel.place
    radius = machine.radius
    width = 0.4 * radius
    damping = 0.0 if wheel.driven else physics.bearing
    rotor = _compute_rotor(machine, physics) if wheel.driven else 0.0
    if wheel.lean:
        content = _write_rollers(wheel, machine, physics)
    else:
        content = f"""
        <joint name="{wheel.name}" axis="0 1 0" damping="{damping}" armature="{rotor:.8g}"/>
        <geom type="cylinder" mass="{physics.wheel_mass}" size="{radius:.6g} {0.5 * width:.6g}"
              zaxis="0 1 0"/>
        <geom class="tread" type="ellipsoid" mass="0" zaxis="0 1 0"
              size="{radius:.6g} {radius:.6g} {0.5 * width:.6g}"/>"""
    if wheel.steering:
        content = f"""
        <joint name="{wheel.steering}" axis="0 0 1" armature="1e-4"
               damping="{STEERING_STIFFNESS * machine.lags[1]:.6g}"/>
        <geom type="sphere" size="0.005" mass="0.02"/>
        <body>{content}
        </body>"""
    return f"""
      <body pos="{x:.6g} {y:.6g} 0">{content}
      </body>"""


def _write_rollers(wheel: Wheel, machine: Machine, physics: Physics) -> str:
    radius = machine.radius
    rotor = _compute_rotor(machine, physics)
    hub = physics.wheel_mass - physics.rollers * ROLLER_MASS
    rows = ""
    for roller in place_rollers(radius, physics.rollers, wheel.lean):
        x, z = roller.place
        ahead, lean, up = roller.axle
        a, b = roller.across, roller.along
        rows += f"""
        <body pos="{x:.8g} 0 {z:.8g}" zaxis="{ahead:.8g} {lean} {up:.8g}">
          <joint axis="0 0 1" damping="{physics.bearing}" armature="2e-7"/>
          <geom class="tread" type="ellipsoid" mass="{ROLLER_MASS}" size="{a:.8g} {a:.8g} {b:.8g}"/>
        </body>"""
    return f"""
        <joint name="{wheel.name}" axis="0 1 0" armature="{rotor:.8g}"/>
        <geom type="cylinder" mass="{hub:.6g}" size="{0.7 * radius:.6g} {0.3 * radius:.6g}"
              zaxis="0 1 0"/>{rows}"""


def _count_driven(machine: Machine) -> int:
    return sum(wheel.driven for wheel in machine.wheels)


def _compute_rotor(machine: Machine, physics: Physics) -> float:
    """Returns the inertia of a driven wheel's rotor [kg m^2]."""
    share = physics.mass / _count_driven(machine)
    return ROTOR * share * machine.radius**2


def _write_motor(
    transmission: str, machine: Machine, physics: Physics, servo_lag: float
) -> str:
    # Torque = gain x (wanted - actual speed), up to a limit. The wanted speed follows the command
    # with a first-order lag [s], so that the servo is stiff and keeps its speed under load.
    rotor = _compute_rotor(machine, physics)
    mass = physics.mass / _count_driven(machine) + 1.5 * physics.wheel_mass
    inertia = mass * machine.radius**2 + rotor
    if machine.kind == "ackermann":  # one motor drives the robot and all four wheels
        mass = physics.mass + 6.0 * physics.wheel_mass
        inertia = mass * machine.radius**2 + 2.0 * rotor
    lag = machine.lags[0] - servo_lag
    gain = inertia / servo_lag
    torque = inertia * TORQUE_RESERVE * physics.acceleration / machine.radius
    return f"""
    <general {transmission} dyntype="filterexact" dynprm="{lag:.8g}" gainprm="{gain:.8g}"
             biastype="affine" biasprm="0 0 {-gain:.8g}"
             forcerange="{-torque:.8g} {torque:.8g}"/>"""


def _write_car_actuators(machine: Machine, physics: Physics) -> str:
    # The tendon averages the speeds of the rear wheels, and splits the torque like a differential.
    engine = _write_motor('tendon="axle"', machine, physics, SERVO_LAG_S)
    servos = "".join(
        f"""
    <position joint="steer_{side}" kp="{STEERING_STIFFNESS}"
              forcerange="{-STEERING_TORQUE} {STEERING_TORQUE}"/>"""
        for side in ("left", "right")
    )
    return f"""
  <tendon>
    <fixed name="axle"><joint joint="rear_left" coef="0.5"/><joint joint="rear_right" coef="0.5"/>
    </fixed>
  </tendon>
  <actuator>{engine}{servos}
  </actuator>"""


def _write_tie_rod(machine: Machine) -> str:
    # Without a tie rod, the servos pass through angles at which the wheels scrub.
    middle = np.tan(np.linspace(-machine.steepest, machine.steepest, 101))
    left, right = (
        np.arctan2(middle, 1.0 + side * machine.half_ratio * middle)
        for side in (-1.0, 1.0)
    )
    row = polynomial.polyfit(left, right, [1, 2, 3, 4])
    if np.abs(polynomial.polyval(left, row) - right).max() > MISFIT:
        return ""
    terms = " ".join(f"{factor:.8g}" for factor in row)
    return f"""
  <equality><joint joint1="steer_right" joint2="steer_left" polycoef="{terms}"/></equality>"""
