"""Robots as machines on wheels: sizes, masses, motors and encoders, for any physics engine."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import Array
from nics_drl_bridge.robot.ackermann import track_and_radius
from nics_drl_bridge.robot.kinds import places_of_four, require_textbook
from nics_drl_bridge.robot.spec import RobotSpec

Parameters = dict[str, float]

# torque limit of a steering servo, as of a small hobby servo [N m]
STEERING_TORQUE = 1.0
# maximum radius of a roller, relative to the radius of the wheel
MAX_ROLLER_RADIUS = 0.25
ROLLER_MASS = 0.005
SPHERES = 5  # per roller; nine take twice the time for the same motion
# fraction of a roller's length beyond which its spheres would end in a point
ROLLER_END = 0.95
# added to a roller's inertia, which alone is too small to simulate [kg m^2]
ROTOR_INERTIA = 2e-7
CASTOR_MASS = 0.03  # [kg]
PIVOT_MASS = 0.02  # of the part that steers a wheel [kg]
PIVOT_INERTIA = 1e-4  # [kg m^2]
# actual twist of a mecanum robot relative to its wheels' twist, measured in sideways drives
ROLLED = 1.0, 0.9884, 1.0


@dataclass(frozen=True)
class Physics:
    """Parameters of a machine that a RobotSpec does not have; defaults are for a small robot."""

    timestep: float = 0.001  # time step of the engine [s]
    mass: float = 4.0  # chassis with load, without wheels [kg]
    wheel_mass: float = 0.15  # one wheel [kg]
    friction: float = 1.0  # between tyre and floor
    # acceleration of the robot after the maximum step of a command [m/s^2]
    acceleration: float = 5.0
    # time constant of a tyre pressed into the floor [s]
    softness: float = 0.005
    bearing: float = 1e-6  # viscous friction of free wheels and rollers [N m s/rad]
    rollers: int = 12  # per mecanum wheel
    # of the gyro, read every 0.01 s, of robots that take the turn rate from it
    gyro_bias: float = 0.0  # [rad/s]
    gyro_noise: float = 0.0  # standard deviation of a reading [rad/s]


@dataclass(frozen=True)
class Wheel:
    """A wheel, which rolls about y."""

    name: str  # name of its joint
    place: tuple[float, float]  # x, y of its centre in `base_link` [m]
    driven: bool = True
    steering: str = ""  # name of the joint about z that steers it; empty: none
    # of a mecanum wheel: 1 if the axle of the roller on the floor points forward and left, else -1
    lean: int = 0


@dataclass(frozen=True)
class Machine:
    """A robot on wheels; `base_link` is at the height of the axles."""

    kind: str
    radius: float  # of the wheels [m]
    centre: tuple[
        float, float, float
    ]  # centre of mass of the chassis in `base_link` [m]
    size: tuple[float, float, float]  # size of the chassis [m]
    wheels: tuple[Wheel, ...]
    lags: tuple[float, ...]  # (S,) lags of the motors behind each wanted state [s]
    joints: tuple[str, ...]  # names of the J joints with encoders
    # maps a wanted state (S,) to the actuators' inputs (U,)
    controls: Callable[[Array], Array]
    # maps joint positions [rad] and speeds [rad/s] (J,) to the state (S,)
    state: Callable[[Array, Array], Array]
    castor: tuple[float, float] | None = None  # x and radius of a ball [m]
    half_ratio: float = 0.0  # half the track over the wheelbase, of wheels that steer
    steepest: float = 0.0  # maximum steering angle [rad]
    # actual twist relative to the wheels' twist
    calibrated: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gyro: bool = False  # True: odometry gets the turn rate from a gyro, not from wheels


def weigh_chassis(machine: Machine, physics: Physics) -> Array:
    """Returns the moments of inertia (3,) of a chassis about its centre [kg m^2]."""
    squares = np.square(machine.size)
    return np.asarray(physics.mass * (squares.sum() - squares) / 12.0)


def weigh_wheel(
    wheel: Wheel, machine: Machine, physics: Physics
) -> tuple[float, Array]:
    """Returns the mass [kg] and moments of inertia (3,) [kg m^2] of a wheel without rollers."""
    mass = physics.wheel_mass
    radius = machine.radius
    width = 0.4 * radius
    if wheel.lean:
        mass -= physics.rollers * ROLLER_MASS
        radius *= 0.7
    across = mass * (3.0 * radius**2 + width**2) / 12.0
    return mass, np.array([across, 0.5 * mass * radius**2, across])


def design_machine(spec: RobotSpec, physics: Physics, engine: str) -> Machine:
    """Designs a robot's machine. Raises ConfigError for an unknown kind or a missing parameter."""
    kind = require_textbook(spec)
    if kind not in _DESIGNS:
        fix = f"take one of {', '.join(_DESIGNS)}, or the fast simulator."
        raise ConfigError(
            f"robot {spec.name!r}: {engine} has no machine of the kind {kind!r}; {fix}"
        )
    if any(v.twist is not None for v in spec.state):
        fault = f"{engine}'s machines measure actuators, not a twist"
        raise ConfigError(f"robot {spec.name!r}: {fault}; correct `state:`.")
    step = max(c.max - c.min for c in spec.command if not c.turns)
    steepest = max(
        (max(-v.min, v.max) for v in spec.state if v.unit == "rad"), default=0.0
    )
    try:
        machine = _DESIGNS[kind](spec.parameters)
    except KeyError as error:
        reason = f"the {kind} machine needs the parameter {error}; add it under `parameters:`."
        raise ConfigError(f"robot {spec.name!r}: {reason}") from None
    # Spinning or locked wheels do not steer, so the lag is longer if the maximum step [m/s] would
    # accelerate the robot too much.
    lag = max(machine.lags[0], step / physics.acceleration)
    lags = (lag, *machine.lags[1:]) if kind == "ackermann" else (lag,) * len(spec.state)
    return replace(machine, lags=lags, steepest=steepest)


def _design_ackermann(p: Parameters) -> Machine:
    # One motor turns both rear wheels by a differential.
    wheelbase = p["wheelbase"]
    track, radius = track_and_radius(p)
    half_ratio = 0.5 * track / wheelbase

    def controls(state: Array) -> Array:
        speed, steering = state
        # `steering` is the angle of a virtual middle wheel; all wheels turn about one centre.
        t = np.tan(steering)
        left = t / (1.0 - half_ratio * t)
        right = t / (1.0 + half_ratio * t)
        return np.array([speed / radius, np.arctan(left), np.arctan(right)])

    def measure_state(position: Array, speed: Array) -> Array:
        tangents = np.tan(position[2:])
        middle = tangents / (1.0 + half_ratio * np.array([1.0, -1.0]) * tangents)
        return np.array(
            [0.5 * radius * (speed[0] + speed[1]), np.arctan(np.mean(middle))]
        )

    return Machine(
        kind="ackermann",
        radius=radius,
        centre=(0.45 * wheelbase, 0.0, 0.0),
        size=(1.3 * wheelbase, 0.7 * track, 0.04),
        wheels=_place_ackermann_wheels(wheelbase, track),
        lags=(p["speed_lag"], p["steering_lag"]),
        joints=("rear_left", "rear_right", "steer_left", "steer_right"),
        controls=controls,
        state=measure_state,
        half_ratio=half_ratio,
    )


def _place_ackermann_wheels(wheelbase: float, track: float) -> tuple[Wheel, ...]:
    wheels = []
    for side, y in (("left", 0.5 * track), ("right", -0.5 * track)):
        wheels.append(Wheel(f"rear_{side}", (0.0, y)))
        steering = f"steer_{side}"
        wheels.append(Wheel(f"front_{side}", (wheelbase, y), False, steering))
    return tuple(wheels)


def _design_differential(p: Parameters) -> Machine:
    radius = p["wheel_radius"]
    track = p["track"]
    return Machine(
        kind="differential",
        radius=radius,
        # The centre of mass is low and just behind the axle: braking must not tip the robot over,
        # and a mass far behind would push it further into every turn.
        centre=(-0.06 * track, 0.0, -0.55 * radius),
        size=(track, 0.7 * track, 0.03),
        wheels=(Wheel("left", (0.0, 0.5 * track)), Wheel("right", (0.0, -0.5 * track))),
        lags=(p["wheel_lag"],),
        joints=("left", "right"),
        controls=lambda state: state,
        state=lambda _, speed: speed,
        castor=(-0.5 * track, 0.4 * radius),
    )


def _design_mecanum(p: Parameters) -> Machine:
    # Engines can't align anisotropic friction with the roller at the bottom of a turning wheel.
    # Free rollers are robust, and reproduce the slight vibration of real wheels.
    radius = p["wheel_radius"]
    x = p["half_length"]
    y = p["half_width"]
    wheels = (
        Wheel("front_left", (x, y), lean=-1),
        Wheel("front_right", (x, -y), lean=1),
        Wheel("rear_left", (-x, y), lean=1),
        Wheel("rear_right", (-x, -y), lean=-1),
    )
    return Machine(
        kind="mecanum",
        radius=radius,
        centre=(0, 0, 0),
        size=(2.2 * x, 1.4 * y, 0.04),
        wheels=wheels,
        lags=(p["wheel_lag"],),
        joints=tuple(wheel.name for wheel in wheels),
        controls=lambda state: state,
        state=lambda _, speed: speed,
        calibrated=ROLLED,
        # In diagonal drives two wheels stand still, each on a roller touching the floor anywhere
        # along its length. They turn the robot by up to 0.03 rad/s, which only a gyro measures.
        gyro=True,
    )


def _design_skid_steer(p: Parameters) -> Machine:
    # Each wheel has one contact point, so the skidding in a turn follows from the wheels' places.
    radius = p["wheel_radius"]
    places = places_of_four(p)
    x, y = places["front_left"]
    return Machine(
        kind="skid_steer",
        radius=radius,
        centre=(0.0, 0.0, 0.0),
        size=(2.0 * x + radius, 1.4 * y, 0.1),
        wheels=tuple(Wheel(name, place) for name, place in places.items()),
        lags=(p["wheel_lag"],),
        joints=tuple(places),
        controls=lambda state: np.tile(state, 2),
        state=lambda _, speed: 0.5 * (speed[:2] + speed[2:]),
        # Skidding varies with speed and curvature, so such robots take the turn rate from a gyro.
        gyro=True,
    )


_DESIGNS: dict[str, Callable[[Parameters], Machine]] = {
    "ackermann": _design_ackermann,
    "differential": _design_differential,
    "mecanum": _design_mecanum,
    "skid_steer": _design_skid_steer,
}


@dataclass(frozen=True)
class Roller:
    """A free roller of a mecanum wheel: an ellipsoid about its axle."""

    place: tuple[float, float]  # x, z of its middle in the wheel [m]
    axle: tuple[float, float, float]  # direction in the wheel, not of unit length
    across: float  # semi-axis across the axle [m]
    along: float  # semi-axis along the axle [m]

    @property
    def spheres(self) -> tuple[Array, Array]:
        """Radii (SPHERES,) of inscribed spheres and their places along the axle (SPHERES,) [m]."""
        a = self.across
        b = self.along
        places = np.linspace(-ROLLER_END, ROLLER_END, SPHERES) * (b - a * a / b)
        return a * np.sqrt(1.0 - places**2 / (b * b - a * a)), places

    @property
    def inertia(self) -> float:
        """Moment of inertia about its centre, including the rotor's [kg m^2]."""
        across = 0.2 * ROLLER_MASS * (self.across**2 + self.along**2)
        return across + ROTOR_INERTIA


def place_rollers(radius: float, rollers: int, lean: int) -> list[Roller]:
    """Places the rollers of a mecanum wheel; `lean`: see `Wheel`."""
    across, along = fit_roller(radius, rollers)
    placed = []
    for angle in 2.0 * np.pi * np.arange(rollers) / rollers:
        s = float(np.sin(angle))
        c = float(np.cos(angle))
        place = (-(radius - across) * s, -(radius - across) * c)
        placed.append(Roller(place, (c, lean, -s), across, along))
    return placed


def fit_roller(radius: float, rollers: int) -> tuple[float, float]:
    """Returns semi-axes [m], across and along, of ellipsoidal rollers that best form a circle."""
    a = MAX_ROLLER_RADIUS * radius
    q = np.pi / rollers
    reach = radius - (radius - a) * np.cos(q)
    return float(a), float(np.sqrt(a**2 + 2.0 * (reach**2 - a**2) / np.sin(q) ** 2))
