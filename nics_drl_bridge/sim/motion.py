"""How obstacles move: what a world file says of it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from nics_drl_bridge.config import Schema


class Wander(Schema):
    """Straight ahead, turning where something is in the way.

    Attributes:
        speed: least and greatest [m/s].
    """

    kind: Literal["wander"] = "wander"
    speed: tuple[float, float]


class Patrol(Schema):
    """From waypoint to waypoint.

    Attributes:
        waypoints: x, y in `map` [m].
        speed: [m/s].
        loop: from the last waypoint to the first; otherwise back and forth.
    """

    kind: Literal["patrol"] = "patrol"
    waypoints: tuple[tuple[float, float], ...] = Field(min_length=2)
    speed: float = Field(gt=0.0)
    loop: bool = True


class Pedestrian(Schema):
    """As people walk.

    Attributes:
        speed: least and greatest [m/s].
    """

    kind: Literal["pedestrian"] = "pedestrian"
    speed: tuple[float, float]


Motion = Annotated[Wander | Patrol | Pedestrian, Field(discriminator="kind")]
