"""URDF of a robot, for RViz and robot_state_publisher (REP-103)."""

import math
from collections.abc import Mapping
from xml.etree import ElementTree

from nics_drl_bridge.robot.kinds import Wheel, drawing
from nics_drl_bridge.robot.spec import RobotSpec

Element = ElementTree.Element
Place = tuple[float, float, float]
COLOURS = {"body": "0.2 0.4 0.7 1", "wheel": "0.1 0.1 0.1 1", "laser": "0.7 0.1 0.1 1"}
BODY_HEIGHT = 0.04


def make_urdf(
    spec: RobotSpec,
    mount: Place = (0.0, 0.0, 0.0),
    laser: str = "laser",
    base: str = "base_link",
    further: Mapping[str, Place] | None = None,
) -> str:
    """Returns the text of a robot's URDF.

    `base_link` and wheels stand on the ground; `laser` is at the height of `base_link`, as the
    package's world is flat. Moving joints have the names of the state variables in `joint_states`.
    A robot without textbook kinematics has no wheels here. Mounts are x [m], y [m], heading [rad]
    in `base`, of the lidar's frame `laser` and of the `further` sensors by frame.
    """
    robot = Element("robot", name=spec.name)
    for name, colour in COLOURS.items():
        _add(_add(robot, "material", name=name), "color", rgba=colour)
    link = _add(robot, "link", name=base)
    disc = (spec.footprint_radius, BODY_HEIGHT)
    _collision(_add(link, "collision"), spec)
    if spec.textbook is None:
        _visual(link, "body", disc, (0.0, 0.0, BODY_HEIGHT))
    else:
        looks = drawing(spec)
        body = looks.body if isinstance(looks.body, tuple) else (looks.body,)
        _visual(
            link, "body", (*body, BODY_HEIGHT), (looks.centre[0], 0.0, looks.centre[1])
        )
        for wheel in looks.wheels:
            _wheel(robot, base, wheel)
    for frame, (x, y, yaw) in {laser: mount, **(further or {})}.items():
        _visual(
            _add(robot, "link", name=frame), "laser", (0.02, 0.03), (0.0, 0.0, 0.07)
        )
        joint = "laser_mount" if frame == laser else f"{frame}_mount"
        _joint(robot, joint, "fixed", (base, frame), (x, y, 0.0), yaw=yaw)
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def _collision(parent: Element, spec: RobotSpec) -> None:
    """Adds the footprint: a disc, or the box around its corners, as URDF has no prism."""
    if spec.footprint is None:
        _geometry(parent, (spec.footprint_radius, BODY_HEIGHT), (0.0, 0.0, BODY_HEIGHT))
        return
    (back, front), (right, left) = (
        (min(of), max(of)) for of in zip(*spec.footprint, strict=True)
    )
    middle = (0.5 * (back + front), 0.5 * (right + left), BODY_HEIGHT)
    _geometry(parent, (front - back, left - right, BODY_HEIGHT), middle)


def _wheel(robot: Element, parent: str, wheel: Wheel) -> None:
    """Adds a wheel; one that turns turns forwards about y, a steered one's pivot about z."""
    place: Place = (*wheel.place, wheel.radius)
    if wheel.pivot is not None:
        pivot = wheel.pivot
        angle = wheel.pivot.angle
        _add(robot, "link", name=pivot.link)
        joint = _joint(robot, pivot.joint, "revolute", (parent, pivot.link), place)
        _add(joint, "axis", xyz="0 0 1")
        limits = {"lower": f"{angle.min:g}", "upper": f"{angle.max:g}"}
        _add(joint, "limit", **limits, effort="1", velocity="10")
        if pivot.joint != angle.name:
            _add(joint, "mimic", joint=angle.name)
        parent = pivot.link
        place = (0.0, 0.0, 0.0)
    name = wheel.name
    kind = "continuous" if wheel.turns else "fixed"
    joint = _joint(robot, name, kind, (parent, f"{name}_link"), place)
    if wheel.turns:
        _add(joint, "axis", xyz="0 1 0")
    size = (wheel.radius, 0.4 * wheel.radius)
    link = _add(robot, "link", name=f"{name}_link")
    _visual(link, "wheel", size, (0.0, 0.0, 0.0), roll=0.5 * math.pi)


def _add(parent: Element, tag: str, **attributes: str) -> Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _numbers(*values: float) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _joint(
    robot: Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    place: Place,
    yaw: float = 0.0,
) -> Element:
    joint = _add(robot, "joint", name=name, type=kind)
    _add(joint, "origin", xyz=_numbers(*place), rpy=_numbers(0.0, 0.0, yaw))
    _add(joint, "parent", link=links[0])
    _add(joint, "child", link=links[1])
    return joint


def _visual(
    link: Element, material: str, size: tuple[float, ...], at: Place, roll: float = 0.0
) -> None:
    visual = _add(link, "visual")
    _geometry(visual, size, at, roll)
    _add(visual, "material", name=material)


def _geometry(
    parent: Element, size: tuple[float, ...], at: Place, roll: float = 0.0
) -> None:
    _add(parent, "origin", xyz=_numbers(*at), rpy=_numbers(roll, 0.0, 0.0))
    shape = _add(parent, "geometry")
    if len(size) == 3:
        _add(shape, "box", size=_numbers(*size))
    else:
        _add(shape, "cylinder", radius=_numbers(size[0]), length=_numbers(size[1]))
