"""A mecanum wheel with real rollers, as MJCF."""

from __future__ import annotations

import numpy as np

from nics_drl_bridge.highfidelity.machine import Physics

THICKNESS = 0.25
"""Radius of a roller at its middle, per radius of the wheel."""
ROLLER_MASS = 0.005


def roller_size(radius: float, rollers: int) -> tuple[float, float]:
    """Semi-axes [m] of the ellipsoids whose outline is nearest to a circle.

    Seen from the side, an ellipsoid at angle q from the bottom reaches
    `(R - a) cos q + sqrt(a^2 + (b^2 - a^2) sin^2 q / 2)` below the axle. It is as long (b) as
    makes this R at q = 0 and where the next roller takes over, at half the angle between two.

    Args:
        radius: R, of the wheel [m].
        rollers: number of rollers.

    Returns:
        Thickness a and length b, as semi-axes.
    """
    a, q = THICKNESS * radius, np.pi / rollers
    reach = radius - (radius - a) * np.cos(q)
    b = np.sqrt(a**2 + 2.0 * (reach**2 - a**2) / np.sin(q) ** 2)
    return float(a), float(b)


def roller_wheel(
    name: str, place: tuple[float, float], lean: int, radius: float, physics: Physics
) -> str:
    """The body of a wheel: a driven hub, and free rollers at 45 degrees to its axle.

    Args:
        name: of the wheel's joint.
        place: (x, y) of the wheel in `base_link` [m].
        lean: +1 where the axle of the roller on the floor points forward and left, -1 where it
            points forward and right.
        radius: of the wheel [m].
        physics: gives masses and bearings.
    """
    a, b = roller_size(radius, physics.rollers)
    hub = physics.wheel_mass - physics.rollers * ROLLER_MASS
    rows = []
    for angle in 2.0 * np.pi * np.arange(physics.rollers) / physics.rollers:
        s, c = np.sin(angle), np.cos(angle)
        x, z = -(radius - a) * s, -(radius - a) * c
        rows.append(f"""
        <body pos="{x:.8g} 0 {z:.8g}" zaxis="{c:.8g} {lean} {-s:.8g}">
          <joint axis="0 0 1" damping="{physics.bearing}" armature="2e-7"/>
          <geom class="tread" type="ellipsoid" mass="{ROLLER_MASS}" size="{a:.8g} {a:.8g} {b:.8g}"/>
        </body>""")
    return f"""
      <body pos="{place[0]:.6g} {place[1]:.6g} 0">
        <joint name="{name}" axis="0 1 0"/>
        <geom type="cylinder" mass="{hub:.6g}" size="{0.7 * radius:.6g} {0.3 * radius:.6g}"
              zaxis="0 1 0"/>{"".join(rows)}
      </body>"""
