"""URDF of a robot, for RViz and robot_state_publisher (REP-103)."""

from __future__ import annotations

import math
from collections.abc import Callable
from xml.etree import ElementTree

from nics_drl_bridge.robot.spec import RobotSpec

Element = ElementTree.Element
Parameters = dict[str, float]
Place = tuple[float, float, float]

COLOURS = {"body": "0.2 0.4 0.7 1", "wheel": "0.1 0.1 0.1 1", "laser": "0.7 0.1 0.1 1"}
BODY_HEIGHT = 0.04
LASER_RADIUS, LASER_HEIGHT = 0.02, 0.03


def urdf_of(
    spec: RobotSpec, mount: Place = (0.0, 0.0, 0.0), laser: str = "laser", base: str = "base_link"
) -> str:
    """Returns the text of a robot's URDF.

    `base_link` lies on the ground, where its pose is measured; wheels stand on the ground and
    `laser` is at its mount, at the height of `base_link`, since the package's world is flat.
    Moving joints have the names of the state variables in `joint_states`. A robot without
    textbook kinematics has no wheels here, since its spec does not contain their positions.

    Args:
        spec: of the robot.
        mount: x [m], y [m], heading [rad] of the lidar in the base.
        laser: frame id of the lidar.
        base: frame id of the robot.
    """
    robot = Element("robot", name=spec.name)
    for name, colour in COLOURS.items():
        ElementTree.SubElement(_add(robot, "material", name=name), "color", rgba=colour)
    link = _add(robot, "link", name=base)
    collision = _add(link, "collision")
    _cylinder(collision, spec.footprint_radius, BODY_HEIGHT, (0.0, 0.0, BODY_HEIGHT))
    if spec.textbook is None:
        _visual_cylinder(link, "body", spec.footprint_radius, BODY_HEIGHT, BODY_HEIGHT)
    else:
        _WHEELS[spec.textbook](robot, link, spec)
    _visual_cylinder(_add(robot, "link", name=laser), "laser", LASER_RADIUS, LASER_HEIGHT, 0.07)
    _joint(robot, "laser_mount", "fixed", (base, laser), (*mount[:2], 0.0), yaw=mount[2])
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def car_wheels(parameters: Parameters) -> tuple[float, float]:
    """Returns `track` and `wheel_radius` of a car [m]; by default shares of its wheelbase."""
    wheelbase = parameters["wheelbase"]
    return (
        parameters.get("track", 0.8 * wheelbase),
        parameters.get("wheel_radius", 0.18 * wheelbase),
    )


def _car(robot: Element, base: Element, spec: RobotSpec) -> None:
    wheelbase = spec.parameters["wheelbase"]
    track, radius = car_wheels(spec.parameters)
    _visual_box(base, (1.3 * wheelbase, 0.7 * track), (0.45 * wheelbase, radius))
    steering = next(variable for variable in spec.state if variable.unit == "rad")
    name = base.attrib["name"]
    for side, y in (("left", 0.5 * track), ("right", -0.5 * track)):
        _wheel(robot, (name, f"rear_{side}_wheel"), (0.0, y, radius), radius, "fixed")
        knuckle = f"{side}_knuckle"
        _add(robot, "link", name=knuckle)
        which = steering.name if side == "left" else f"{steering.name}_right"
        joint = _joint(robot, which, "revolute", (name, knuckle), (wheelbase, y, radius))
        _add(joint, "axis", xyz="0 0 1")
        limits = {"lower": f"{steering.min:g}", "upper": f"{steering.max:g}"}
        _add(joint, "limit", **limits, effort="1", velocity="10")
        if side == "right":
            _add(joint, "mimic", joint=steering.name)
        _wheel(robot, (knuckle, f"front_{side}_wheel"), (0.0, 0.0, 0.0), radius, "fixed")


def _differential(robot: Element, base: Element, spec: RobotSpec) -> None:
    track, radius = spec.parameters["track"], spec.parameters["wheel_radius"]
    _visual_cylinder(base, "body", 0.4 * track, BODY_HEIGHT, radius)
    for variable, y in zip(spec.state, (0.5 * track, -0.5 * track), strict=True):
        _wheel(robot, (base.attrib["name"], variable.name), (0.0, y, radius), radius)


def _mecanum(robot: Element, base: Element, spec: RobotSpec) -> None:
    p = spec.parameters
    length, width, radius = p["half_length"], p["half_width"], p["wheel_radius"]
    _visual_box(base, (2.0 * length + radius, 1.4 * width), (0.0, radius))
    places = ((length, width), (length, -width), (-length, width), (-length, -width))
    for variable, place in zip(spec.state, places, strict=True):
        _wheel(robot, (base.attrib["name"], variable.name), (*place, radius), radius)


_WHEELS: dict[str, Callable[[Element, Element, RobotSpec], None]] = {
    "ackermann": _car,
    "differential": _differential,
    "mecanum": _mecanum,
}


def _add(parent: Element, tag: str, **attributes: str) -> Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _joint(
    robot: Element, name: str, kind: str, links: tuple[str, str], place: Place, yaw: float = 0.0
) -> Element:
    joint = _add(robot, "joint", name=name, type=kind)
    _add(joint, "origin", xyz=_numbers(*place), rpy=_numbers(0.0, 0.0, yaw))
    _add(joint, "parent", link=links[0])
    _add(joint, "child", link=links[1])
    return joint


def _wheel(
    robot: Element, links: tuple[str, str], place: Place, radius: float, kind: str = "continuous"
) -> None:
    """Adds a wheel whose joint turns forwards about y and has the name of the wheel."""
    name = links[1]
    joint = _joint(robot, name, kind, (links[0], f"{name}_link"), place)
    if kind == "continuous":
        _add(joint, "axis", xyz="0 1 0")
    visual = _add(_add(robot, "link", name=f"{name}_link"), "visual")
    _cylinder(visual, radius, 0.4 * radius, (0.0, 0.0, 0.0), roll=0.5 * math.pi)
    _add(visual, "material", name="wheel")


def _cylinder(parent: Element, radius: float, length: float, at: Place, roll: float = 0.0) -> None:
    _add(parent, "origin", xyz=_numbers(*at), rpy=_numbers(roll, 0.0, 0.0))
    shape = _add(parent, "geometry")
    _add(shape, "cylinder", radius=f"{radius:.6g}", length=f"{length:.6g}")


def _visual_cylinder(
    link: Element, material: str, radius: float, height: float, centre: float
) -> None:
    visual = _add(link, "visual")
    _cylinder(visual, radius, height, (0.0, 0.0, centre))
    _add(visual, "material", name=material)


def _visual_box(link: Element, size: tuple[float, float], centre: tuple[float, float]) -> None:
    """Adds a body of the given length and width, at the given x and height."""
    visual = _add(link, "visual")
    _add(visual, "origin", xyz=_numbers(centre[0], 0.0, centre[1]), rpy="0 0 0")
    _add(_add(visual, "geometry"), "box", size=_numbers(*size, BODY_HEIGHT))
    _add(visual, "material", name="body")
