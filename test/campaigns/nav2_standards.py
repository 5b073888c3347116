"""Nav2: does the map show the world, does the policy follow planned paths, is every name served?

The map of an episode is compared with the world by an exact lidar: a beam agrees that ends within
one and a half cells of what it, or the beams beside it, show in the world; `map_same_beam` is the
share that end within 5 cm of what the same beam shows, edges of obstacles included. Paths that are
planned on that map are sent to `follow_path`, in lock-step over DDS, by a stand-in for the
behaviour tree; one is followed if the action succeeds, at the goal, without a touch. The last
figure counts topics, frames, types, qualities of service and actions that Nav2's parameter file
names and nobody serves. Needs nav2_msgs and tf2_msgs for the last two: source what
`nox -s messages` builds.
"""

from __future__ import annotations

import math
import tarfile
import tempfile
import threading
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from campaign import Given, Result, at_least, at_most, run_campaign

from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.occupancy import occupancy, standing
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.world_set import load_worlds

BARS = {
    "map_agreement": at_least(0.995),
    "follow_path_success": at_least(0.95),
    "nav2_names_missing": at_most(0),
}
WORLDS = ("arena", "circles", "clutter", "corridor", "doorway", "room", "barn")
ROBOT = "differential"
WORLD = "room"
LIDAR = "rplidar_a2"
POSES = 100
ROOM = 0.05  # by which planned paths keep away from walls beyond the footprint [m]
SAME_M = 0.05  # by which two ranges of one beam may differ [m]
NEAR = 0.35  # from the goal at the end, by the truth [m]
# longest time until all is served [s]
STARTED_S = 300.0
BARE_S = 60.0
ARCHIVE = (
    Path(__file__).resolve().parents[3]
    / "shared"
    / "upstream"
    / "nav2_interfaces.tar.gz"
)
UPSTREAM = "navigation2/nav2_bringup/params/nav2_params.yaml"


def map_agreement(
    name: str, seeds: range = range(3), bare: bool = False
) -> tuple[float, float]:
    """Share of beams that agree, in a world's episodes, and of those whose own range does."""
    worlds = load_worlds(name)
    lidar = load_lidar(LIDAR)
    shares = []
    sampler = SceneSampler(worlds, load_robot(ROBOT).footprint_radius)
    for seed in seeds:
        scene = sampler.draw([seed])[0]
        world = worlds.members[int(scene.member)]
        placed = standing(sampler, int(scene.member), scene.bodies)
        grid = occupancy(world, [] if bare else placed)
        shapes = [shape for shape, _ in placed]
        at = [pose for _, pose in placed]
        exact = make_scanner(lidar, shapes, "exact", world.grid)
        free = np.argwhere(grid.distance_field > 0.2)
        free = free[np.random.default_rng(seed).integers(len(free), size=POSES)]
        poses = np.column_stack(
            [grid.cell_to_world(free), np.linspace(-3.0, 3.0, POSES)]
        )
        bodies = np.tile(exact.place(shapes, np.reshape(at, (-1, 3))), (POSES, 1, 1))
        true = exact.scan(poses, bodies, world.all_walls())
        seen = make_scanner(lidar, [], "exact", grid).scan(poses, [])
        around = np.stack([np.roll(true, k, 1) for k in (-1, 0, 1)])
        slack = 1.5 * grid.resolution
        low = around.min(axis=0) - slack
        high = around.max(axis=0) + slack
        same = (np.abs(seen - true) <= SAME_M) | (seen == true)  # both may see nothing
        shares.append((np.mean((seen >= low) & (seen <= high)), np.mean(same)))
    agreed, of_one = np.mean(shares, axis=0).tolist()
    return agreed, of_one


def followed(
    domain_id: int, folder: Path, episodes: int, bare: bool = False
) -> dict[str, Any]:
    """Share of planned paths that are followed over DDS, and why the others were not."""
    from nav2_msgs.action import FollowPath
    from parts.nav2_stand_in import StandIn
    from rcl_interfaces.srv import SetParametersAtomically
    from rclpy.parameter import Parameter
    from std_srvs.srv import Trigger

    from nics_drl_bridge.nodes.processes import NodeProcess

    radius = load_robot(ROBOT).footprint_radius
    worlds = load_worlds(WORLD)
    sampler = SceneSampler(worlds, radius)
    common: dict[str, Any] = {"model": ROBOT, "enable_stamped_cmd_vel": False}
    simulated = common | {"world": WORLD, "mode": "lockstep"}
    policy = common | {"policy": ROBOT, "rate": 0.0, "deadline": 30.0}
    policy |= {"costmap_update_timeout": 60.0}
    why: list[str] = []
    with ExitStack() as opened:
        for name, given in (("simulator_node", simulated), ("policy_node", policy)):
            opened.enter_context(NodeProcess(name, folder, given, domain_id))
        tree = StandIn(domain_id, FollowPath, "Nobody" if bare else "FollowPath")
        opened.callback(tree.close)
        tree.wait_for(tree.client.server_is_ready, "the action follow_path", kick=True)
        tree.wait_for(
            lambda: tree.poses.get_subscription_count() >= 2, "both ends of initialpose"
        )
        for seed in range(episodes):
            request = SetParametersAtomically.Request()
            request.parameters = [
                Parameter("episode_seed", value=seed).to_parameter_msg()
            ]
            tree.call(
                SetParametersAtomically,
                "simulator_node/set_parameters_atomically",
                request,
            )
            tree.truths.clear()
            tree.call(Trigger, "simulator_node/reset")
            scene = sampler.draw([seed])[0]
            shown = occupancy(
                worlds, standing(sampler, 0, scene.bodies)
            ).cells.tobytes()
            tree.wait_for(
                lambda shown=shown: tree.shows(shown), "map and truth", kick=True
            )
            tree.place(scene.starts[0])
            result = tree.drive(scene.goals[0], radius + ROOM)
            far = math.dist(tree.pose[:2], scene.goals[0])
            if result.status != 4 or far > NEAR or tree.touched():  # 4: succeeded
                told = (
                    getattr(result.result, "error_msg", "") or f"status {result.status}"
                )
                why.append(
                    f"seed {seed}: {told}, {far:.2f} m off, touched {tree.touched()}"
                )
    return {"follow_path_success": 1.0 - len(why) / episodes, "not_followed": why}


def missing(
    domain_id: int, folder: Path, parameters: Path, bare: bool = False
) -> list[str]:
    """A line for each name of a parameter file of Nav2 that nobody serves."""
    from parts import nav2_names
    from rclpy.node import Node
    from tf2_msgs.msg import TFMessage

    from nics_drl_bridge.nodes import qos
    from nics_drl_bridge.nodes.listener import holds, open_context, spin
    from nics_drl_bridge.nodes.processes import NodeProcess

    frame = "" if bare else "base_footprint"
    simulated = {"model": ROBOT, "world": WORLD, "footprint_frame": frame}
    nodes: dict[str, dict[str, Any]] = {"simulator_node": simulated}
    if not bare:
        nodes |= {"middleware_node": {"model": ROBOT}, "policy_node": {"model": ROBOT}}
    topics, frames = nav2_names.wanted(parameters)
    with ExitStack() as opened:
        for name, given in nodes.items():
            opened.enter_context(NodeProcess(name, folder, given, domain_id))
        context = open_context(domain_id=domain_id)
        opened.callback(context.try_shutdown)
        node, told, ended = (
            Node("asker", context=context),
            list[Any](),
            threading.Event(),
        )
        node.create_subscription(TFMessage, "/tf", told.append, qos.TRANSFORMS)
        node.create_subscription(TFMessage, "/tf_static", told.append, qos.LATCHED)
        thread = threading.Thread(target=spin, args=(node, ended), daemon=True)
        thread.start()

        def faults() -> list[str]:
            known = nav2_names.frames_in(list(told))
            lacking = [
                f"{each}: no such frame on /tf" for each in sorted(frames - known)
            ]
            found = nav2_names.unserved_topics(node, topics) + lacking
            return found + nav2_names.unserved_actions(node)

        holds(lambda: not faults(), BARE_S if bare else STARTED_S, 0.5)
        found = faults()
        ended.set()
        thread.join()
        return found


def parameters_in(folder: Path, given: Path | None) -> Path | None:
    """The parameter file of Nav2: the given one, or that of its archive where it lies."""
    if given is not None:
        return given
    if not ARCHIVE.is_file():
        return None
    with tarfile.open(ARCHIVE) as archive:
        archive.extract(UPSTREAM, folder, filter="data")
    return folder / UPSTREAM


def figures(
    bare: bool = False, episodes: int = 20, parameters: Path | None = None
) -> dict[str, Any]:
    """The figures of `BARS`; NaN for what needs messages that `nox -s messages` builds."""
    shares = {name: map_agreement(name, bare=bare) for name in WORLDS}
    least, same = (min(each) for each in zip(*shares.values(), strict=True))
    result: dict[str, Any] = {"map_agreement": least, "map_same_beam": same}
    result["map_agreements"] = shares
    result |= {"follow_path_success": math.nan, "nav2_names_missing": math.nan}
    if None in (find_spec("rclpy"), find_spec("nav2_msgs"), find_spec("tf2_msgs")):
        return result
    from nics_drl_bridge.nodes.processes import free_domain_id

    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        file = parameters_in(folder, parameters)
        if file is not None:
            result["missing"] = missing(free_domain_id(), folder / "names", file, bare)
            result["nav2_names_missing"] = len(result["missing"])
        result |= followed(free_domain_id(), folder / "paths", episodes, bare)
    return result


def measure(given: Given) -> Result:
    """All figures."""
    return figures(given.control is not None, given.episodes, given.parameters)


OPTIONS = {
    "episodes": (20, "paths to follow"),
    "parameters": {"type": Path, "help": "a parameter file of Nav2"},
}


if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
