"""URDF of a robot, for RViz and robot_state_publisher (REP-103)."""

import math
from collections.abc import Mapping
from xml.etree import ElementTree

from nics_drl_bridge.robot.kinds import Wheel, draw_robot
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

    `base_link` and wheels stand on the ground; `laser` is at the height of `base_link`, because the
    package's world is flat. Moving joints have the names of the state variables in `joint_states`.
    A robot without textbook kinematics gets no wheels. `mount` is the pose of the lidar's frame
    `laser` in `base`: x [m], y [m], heading [rad]. `further` are the mounts of other sensors by
    frame.
    """
    robot = Element("robot", name=spec.name)
    for name, colour in COLOURS.items():
        _add(_add(robot, "material", name=name), "color", rgba=colour)
    link = _add(robot, "link", name=base)
    _add_collision(_add(link, "collision"), spec)
    if spec.textbook is None:
        disc = (spec.footprint_radius, BODY_HEIGHT)
        _add_visual(link, "body", disc, (0.0, 0.0, BODY_HEIGHT))
    else:
        drawing = draw_robot(spec)
        body: tuple[float, ...]
        if isinstance(drawing.body, tuple):
            body = drawing.body
        else:
            body = (drawing.body,)
        place = (drawing.centre[0], 0.0, drawing.centre[1])
        _add_visual(link, "body", (*body, BODY_HEIGHT), place)
        for wheel in drawing.wheels:
            _add_wheel(robot, base, wheel)
    mounts = {laser: mount, **(further or {})}
    for frame, sensor_mount in mounts.items():
        joint = "laser_mount" if frame == laser else f"{frame}_mount"
        _add_sensor(robot, base, frame, joint, sensor_mount)
    ElementTree.indent(robot)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(robot, encoding="unicode")}\n'


def _add_collision(parent: Element, spec: RobotSpec) -> None:
    """Adds the footprint: a disc, or the box around its corners, because URDF has no prism."""
    if spec.footprint is None:
        disc = (spec.footprint_radius, BODY_HEIGHT)
        _add_geometry(parent, disc, (0.0, 0.0, BODY_HEIGHT))
        return
    x, y = zip(*spec.footprint, strict=True)
    size = (max(x) - min(x), max(y) - min(y), BODY_HEIGHT)
    middle = (0.5 * (min(x) + max(x)), 0.5 * (min(y) + max(y)), BODY_HEIGHT)
    _add_geometry(parent, size, middle)


def _add_wheel(robot: Element, parent: str, wheel: Wheel) -> None:
    """Adds a wheel, which may roll about y and be steered by a pivot about z."""
    place: Place = (*wheel.place, wheel.radius)
    if wheel.pivot is not None:
        pivot = wheel.pivot
        angle = wheel.pivot.angle
        _add(robot, "link", name=pivot.link)
        joint = _add_joint(robot, pivot.joint, "revolute", (parent, pivot.link), place)
        _add(joint, "axis", xyz="0 0 1")
        _add(
            joint,
            "limit",
            lower=f"{angle.min:g}",
            upper=f"{angle.max:g}",
            effort="1",
            velocity="10",
        )
        if pivot.joint != angle.name:
            _add(joint, "mimic", joint=angle.name)
        parent = pivot.link
        place = (0.0, 0.0, 0.0)
    name = wheel.name
    kind = "continuous" if wheel.turns else "fixed"
    joint = _add_joint(robot, name, kind, (parent, f"{name}_link"), place)
    if wheel.turns:
        _add(joint, "axis", xyz="0 1 0")
    size = (wheel.radius, 0.4 * wheel.radius)
    link = _add(robot, "link", name=f"{name}_link")
    _add_visual(link, "wheel", size, (0.0, 0.0, 0.0), roll=0.5 * math.pi)


def _add_sensor(
    robot: Element,
    base: str,
    frame: str,
    joint: str,
    mount: Place,
) -> None:
    link = _add(robot, "link", name=frame)
    _add_visual(link, "laser", (0.02, 0.03), (0.0, 0.0, 0.07))
    x, y, yaw = mount
    _add_joint(robot, joint, "fixed", (base, frame), (x, y, 0.0), yaw=yaw)


def _add(parent: Element, tag: str, **attributes: str) -> Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _format_numbers(*values: float) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _add_joint(
    robot: Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    place: Place,
    yaw: float = 0.0,
) -> Element:
    joint = _add(robot, "joint", name=name, type=kind)
    _add(
        joint, "origin", xyz=_format_numbers(*place), rpy=_format_numbers(0.0, 0.0, yaw)
    )
    _add(joint, "parent", link=links[0])
    _add(joint, "child", link=links[1])
    return joint


def _add_visual(
    link: Element,
    material: str,
    size: tuple[float, ...],
    place: Place,
    roll: float = 0.0,
) -> None:
    visual = _add(link, "visual")
    _add_geometry(visual, size, place, roll)
    _add(visual, "material", name=material)


def _add_geometry(
    parent: Element,
    size: tuple[float, ...],
    place: Place,
    roll: float = 0.0,
) -> None:
    """Adds a box (length, width, height) or a cylinder (radius, length)."""
    _add(
        parent,
        "origin",
        xyz=_format_numbers(*place),
        rpy=_format_numbers(roll, 0.0, 0.0),
    )
    shape = _add(parent, "geometry")
    if len(size) == 3:
        _add(shape, "box", size=_format_numbers(*size))
    else:
        _add(
            shape,
            "cylinder",
            radius=_format_numbers(size[0]),
            length=_format_numbers(size[1]),
        )
