"""A car: the rear axle drives, the front wheels steer; `base_link` is the middle of the rear axle.

Commanded are the rear axle's speed [m/s] and the steering angle [rad] of a virtual middle wheel.
"""

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.robot.drivetrain import steered, steering_angle
from nics_drl_bridge.robot.kinds import Drawing, Pivot, RobotKind, Textbook, Wheel
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]


def kinematics(spec: RobotSpec) -> Textbook:
    """Curvature tan(angle) / wheelbase."""
    wheelbase = spec.parameters["wheelbase"]

    def twist(speed: Array, angle: Array) -> Array:
        turn = speed * np.tan(angle) / wheelbase
        return np.stack([speed, np.zeros_like(speed), turn], axis=-1)

    return steered(spec, twist)


def track_and_radius(parameters: dict[str, float]) -> tuple[float, float]:
    """Returns `track` and `wheel_radius` [m]; by default shares of the wheelbase."""
    base = parameters["wheelbase"]
    return parameters.get("track", 0.8 * base), parameters.get("wheel_radius", 0.18 * base)


def drawing(spec: RobotSpec) -> Drawing:
    """A box on four wheels; the right front wheel follows the left one."""
    wheelbase, angle = spec.parameters["wheelbase"], steering_angle(spec)
    track, radius = track_and_radius(spec.parameters)
    wheels = []
    for side, y, suffix in (("left", 0.5 * track, ""), ("right", -0.5 * track, "_right")):
        pivot = Pivot(f"{side}_knuckle", angle.name + suffix, angle)
        wheels.append(Wheel(f"rear_{side}_wheel", (0.0, y), radius))
        wheels.append(Wheel(f"front_{side}_wheel", (wheelbase, y), radius, pivot=pivot))
    return Drawing((1.3 * wheelbase, 0.7 * track), (0.45 * wheelbase, radius), tuple(wheels))


KIND = RobotKind(kinematics, drawing)
