"""`nics list`: shipped robots, worlds, lidars and policies, by the names that commands take."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from nics_drl_bridge.commands.console import JsonOption, format_table, print_line
from nics_drl_bridge.config import list_shipped

if TYPE_CHECKING:
    from nics_drl_bridge.sim.world import World

Row = dict[str, Any]


Listed = Literal["robots", "worlds", "lidars", "policies"]


def list_(what: Listed, as_json: JsonOption = False) -> None:
    """Lists the shipped robots, worlds, lidars or policies.

    Args:
        what: What to list.

    Examples:
        nics list robots
        nics list worlds --json
    """
    rows = ROWS[what]()
    cells = [tuple(map(str, row.values())) for row in rows]
    print_line(as_json, format_table(tuple(rows[0]), cells), **{what: rows})


def robots() -> list[Row]:
    """Returns the shipped robots: name, commands with their ranges, lidar, description."""
    from nics_drl_bridge.generator import mount_lidar
    from nics_drl_bridge.robot.spec import load_robot

    rows = []
    for name in list_shipped("robots"):
        robot = load_robot(name)
        commands = [f"{c.name} {c.min:g} to {c.max:g} {c.unit}" for c in robot.command]
        row = {
            "name": name,
            "commands": ", ".join(commands),
            "lidar": mount_lidar(robot).name,
            "description": robot.description,
        }
        rows.append(row)
    return rows


def _count_obstacles(world: "World") -> str:
    counts = [group.counts for group in world.obstacles]
    low = sum(minimum for minimum, _ in counts)
    high = sum(maximum for _, maximum in counts)
    return f"{low}" if low == high else f"{low} to {high}"


def worlds() -> list[Row]:
    """Returns the shipped worlds and world sets: name, size, goal distance, obstacles."""
    from nics_drl_bridge.sim.barn import barn_numbers
    from nics_drl_bridge.sim.world import load_world
    from nics_drl_bridge.sim.world_set import BARN

    rows = []
    for name in list_shipped("worlds"):
        world = load_world(name)
        x1, y1, x2, y2 = world.extent
        size = f"{x2 - x1:g} x {y2 - y1:g}"
        obstacles = _count_obstacles(world)
        rows.append(_describe_world(name, size, obstacles, world.goal_distance))
    barn = f"a set of {len(barn_numbers())} worlds, as barn/7"
    rows.append(_describe_world(BARN, barn))
    for name in list_shipped("world_sets"):
        rows.append(_describe_world(name, "a set of worlds"))
    return rows


def _describe_world(
    name: str, size: str, obstacles: str = "", distance: tuple[float, ...] = ()
) -> Row:
    far = " to ".join(f"{value:g}" for value in distance)
    return {
        "name": name,
        "size [m]": size,
        "goal_distance [m]": far,
        "obstacles": obstacles,
    }


def lidars() -> list[Row]:
    """Returns the shipped lidars: name, beams, field of view, range."""
    from math import degrees

    from nics_drl_bridge.lidar.spec import load_lidar

    rows = []
    for name in list_shipped("lidars"):
        lidar = load_lidar(name)
        row = {
            "name": name,
            "beams": lidar.beams,
            "view [deg]": round(degrees(lidar.angle_max - lidar.angle_min)),
            "range [m]": f"{lidar.range_min:g} to {lidar.range_max:g}",
            "scans [Hz]": lidar.rate,
        }
        rows.append(row)
    return rows


def policies() -> list[Row]:
    """Returns the shipped policy files and the baselines."""
    from nics_drl_bridge.policy.policies import POLICIES, list_shipped_policies

    trained = [
        {"name": name, "kind": "policy file"} for name in list_shipped_policies()
    ]
    return trained + [
        {"name": name, "kind": "baseline, any robot"} for name in sorted(POLICIES)
    ]


ROWS: dict[str, Callable[[], list[Row]]] = {
    "robots": robots,
    "worlds": worlds,
    "lidars": lidars,
    "policies": policies,
}
