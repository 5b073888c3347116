"""What Nav2 wants of a robot: that planned paths are followed, and that all names are served."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from parts import nav2_names
from parts.nav2_stand_in import StandIn
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.listener import SpunNode
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.occupancy import occupancy, standing
from nics_drl_bridge.sim.scenes import SceneSampler
from nics_drl_bridge.sim.world_set import load_worlds

ROBOT = "differential"
WORLD = "room"
ROOM = 0.05  # by which planned paths keep away from walls beyond the footprint [m]
NEAR = 0.35  # from the goal at the end, by the truth [m]
# longest time until all is served [s]
STARTED_S = 300.0
BARE_S = 60.0
SUCCEEDED = 4


def follow_paths(folder: Path, episodes: int, is_bare: bool) -> list[str]:
    """Has planned paths followed over DDS; returns a line for each that was not."""
    domain_id = choose_domain_id()
    radius = load_robot(ROBOT).footprint_radius
    worlds = load_worlds(WORLD)
    sampler = SceneSampler(worlds, radius)
    common: dict[str, Any] = {"model": ROBOT, "enable_stamped_cmd_vel": False}
    policy = {"policy": ROBOT, "rate": 0.0, "deadline": 30.0}
    nodes = {
        "simulator_node": common | {"world": WORLD, "mode": "lockstep"},
        "policy_node": common | policy | {"costmap_update_timeout": 60.0},
    }
    not_followed: list[str] = []
    with ExitStack() as stack:
        for name, parameters in nodes.items():
            process = NodeProcess(name, folder, parameters, domain_id)
            stack.enter_context(process)
        tree = StandIn(domain_id, "Nobody" if is_bare else "FollowPath")
        stack.callback(tree.close)
        tree.wait_for(tree.client.server_is_ready, "the action follow_path")
        tree.wait_for(
            lambda: tree.poses.get_subscription_count() >= 2, "both ends of initialpose"
        )
        for seed in range(episodes):
            scene = sampler.draw([seed])[0]
            shown = occupancy(worlds, standing(sampler, 0, scene.bodies))
            begin_episode(tree, seed, shown.cells.tobytes())
            tree.place(scene.starts[0])
            result = tree.drive(scene.goals[0], radius + ROOM)
            far = math.dist(tree.pose[:2], scene.goals[0])
            has_touched = tree.has_touched()
            if result.status != SUCCEEDED or far > NEAR or has_touched:
                told = getattr(result.result, "error_msg", "") or result.status
                where = f"{far:.2f} m off, touched {has_touched}"
                not_followed.append(f"seed {seed}: {told}, {where}")
    return not_followed


def begin_episode(tree: StandIn, seed: int, cells: bytes) -> None:
    """Resets the simulator to the episode of a seed, whose map has these cells."""
    request = SetParametersAtomically.Request()
    request.parameters = [Parameter("episode_seed", value=seed).to_parameter_msg()]
    tree.call(
        SetParametersAtomically, "simulator_node/set_parameters_atomically", request
    )
    tree.truths.clear()
    tree.call(Trigger, "simulator_node/reset")
    tree.wait_for(lambda: tree.shows(cells), "map and truth")


def find_missing(folder: Path, file: Path, is_bare: bool) -> list[str]:
    """Returns a line for each name of a parameter file of Nav2 that nobody serves."""
    domain_id = choose_domain_id()
    topics, frames = nav2_names.read_wanted(file)
    model = {"model": ROBOT}
    frame = "" if is_bare else "base_footprint"
    nodes: dict[str, dict[str, Any]] = {
        "simulator_node": model | {"world": WORLD, "footprint_frame": frame},
        "middleware_node": model,
        "policy_node": model,
    }
    with ExitStack() as stack:
        for name in list(nodes)[: 1 if is_bare else None]:
            stack.enter_context(NodeProcess(name, folder, nodes[name], domain_id))
        asker = SpunNode("asker", domain_id)
        stack.callback(asker.close)
        heard: list[Any] = []
        for topic, quality in (("/tf", qos.TRANSFORMS), ("/tf_static", qos.LATCHED)):
            asker.node.create_subscription(TFMessage, topic, heard.append, quality)

        def find() -> list[str]:
            lacking = frames - nav2_names.list_frames(heard)
            return [
                *nav2_names.find_unserved_topics(asker.node, topics),
                *(f"{frame}: no such frame on /tf" for frame in sorted(lacking)),
                *nav2_names.find_unserved_actions(asker.node),
            ]

        asker.until(lambda: not find(), BARE_S if is_bare else STARTED_S)
        return find()
