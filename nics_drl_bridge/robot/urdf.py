"""URDF of a robot, for RViz and robot_state_publisher (REP-103)."""

import math
from collections.abc import Mapping
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from nics_drl_bridge.robot.kinds import Drawing, Wheel, draw_robot
from nics_drl_bridge.robot.spec import RobotSpec

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
    parts = [
        f'<material name="{name}"><color rgba="{colour}"/></material>'
        for name, colour in COLOURS.items()
    ]
    drawing = Drawing(spec.footprint_radius, (0.0, BODY_HEIGHT), ())
    if spec.textbook is not None:
        drawing = draw_robot(spec)
    collision = f"<collision>{_write_footprint(spec)}</collision>"
    body = drawing.body if isinstance(drawing.body, tuple) else (drawing.body,)
    x, height = drawing.centre
    visual = _write_visual("body", (*body, BODY_HEIGHT), (x, 0.0, height))
    parts.append(_write_link(base, collision + visual))
    parts += [_write_wheel(base, wheel) for wheel in drawing.wheels]
    for frame, place in {laser: mount, **(further or {})}.items():
        joint = "laser_mount" if frame == laser else f"{frame}_mount"
        x, y, yaw = place
        visual = _write_visual("laser", (0.02, 0.03), (0.0, 0.0, 0.07))
        parts.append(_write_link(frame, visual))
        parts.append(_write_joint(joint, "fixed", base, frame, (x, y, 0.0), yaw))
    robot = f"<robot name={quoteattr(spec.name)}>{''.join(parts)}</robot>"
    root = ElementTree.fromstring(robot)  # noqa: S314 - written above
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def _write_footprint(spec: RobotSpec) -> str:
    """Returns a disc, or the box around the footprint's corners, because URDF has no prism."""
    if spec.footprint is None:
        disc = (spec.footprint_radius, BODY_HEIGHT)
        return _write_shape(disc, (0.0, 0.0, BODY_HEIGHT))
    x, y = zip(*spec.footprint, strict=True)
    size = (max(x) - min(x), max(y) - min(y), BODY_HEIGHT)
    middle = (0.5 * (min(x) + max(x)), 0.5 * (min(y) + max(y)), BODY_HEIGHT)
    return _write_shape(size, middle)


def _write_wheel(parent: str, wheel: Wheel) -> str:
    """Returns a wheel, which may roll about y and be steered by a pivot about z."""
    text = ""
    place: Place = (*wheel.place, wheel.radius)
    pivot = wheel.pivot
    if pivot is not None:
        angle = pivot.angle
        details = (
            f'<axis xyz="0 0 1"/><limit lower="{angle.min:g}" upper="{angle.max:g}" '
            'effort="1" velocity="10"/>'
        )
        if pivot.joint != angle.name:
            details += f'<mimic joint="{angle.name}"/>'
        text = _write_link(pivot.link) + _write_joint(
            pivot.joint, "revolute", parent, pivot.link, place, details=details
        )
        parent = pivot.link
        place = (0.0, 0.0, 0.0)
    link = f"{wheel.name}_link"
    if wheel.turns:
        axis = '<axis xyz="0 1 0"/>'
        text += _write_joint(wheel.name, "continuous", parent, link, place, 0.0, axis)
    else:
        text += _write_joint(wheel.name, "fixed", parent, link, place)
    size = (wheel.radius, 0.4 * wheel.radius)
    visual = _write_visual("wheel", size, (0.0, 0.0, 0.0), roll=0.5 * math.pi)
    return text + _write_link(link, visual)


def _write_link(name: str, content: str = "") -> str:
    return f"<link name={quoteattr(name)}>{content}</link>"


def _write_joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    place: Place,
    yaw: float = 0.0,
    details: str = "",
) -> str:
    return (
        f'<joint name={quoteattr(name)} type="{kind}">{_write_origin(place, yaw=yaw)}'
        f"<parent link={quoteattr(parent)}/><child link={quoteattr(child)}/>{details}</joint>"
    )


def _write_origin(place: Place, roll: float = 0.0, yaw: float = 0.0) -> str:
    x, y, z = place
    return f'<origin xyz="{x:.6g} {y:.6g} {z:.6g}" rpy="{roll:.6g} 0 {yaw:.6g}"/>'


def _write_visual(
    material: str, size: tuple[float, ...], place: Place, roll: float = 0.0
) -> str:
    shape = _write_shape(size, place, roll)
    return f'<visual>{shape}<material name="{material}"/></visual>'


def _write_shape(size: tuple[float, ...], place: Place, roll: float = 0.0) -> str:
    """Returns a box (length, width, height) or a cylinder (radius, length)."""
    numbers = [f"{value:.6g}" for value in size]
    shape = f'<box size="{" ".join(numbers)}"/>'
    if len(size) == 2:
        shape = f'<cylinder radius="{numbers[0]}" length="{numbers[1]}"/>'
    return f"{_write_origin(place, roll)}<geometry>{shape}</geometry>"
