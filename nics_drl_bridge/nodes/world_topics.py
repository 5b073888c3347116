"""A simulator's topics `map`, and `initialpose`, which moves a robot."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import conversions, qos, runner
from nics_drl_bridge.nodes.conversions import INITIAL_POSE, read_initial_pose
from nics_drl_bridge.sim.occupancy import occupancy, standing

if TYPE_CHECKING:
    from nics_drl_bridge.nodes.simulator_node import DeviceNode

LOOK_S = 0.2  # time between two checks of what stands in the world [s]


class WorldTopics:
    """Publishes `map`, the occupancy of everything that stands, and puts robots at `initialpose`.

    The map also reaches late joiners, and is published again when something has changed. It is not
    computed before anyone subscribes.
    """

    def __init__(self, node: "DeviceNode") -> None:
        self._node = node
        self._frame = runner.get_text(node, "map_frame")
        self._cell = runner.get_number(node, "map_resolution")
        self._map = node.create_publisher(OccupancyGrid, "map", qos.LATCHED)
        self._shown: Any = None  # the world that was published, and what stood in it
        runner.call_periodically(node, LOOK_S, self._look)

    def hear(self, namespace: str, robot: Callable[[], int]) -> Any:
        """Subscribe for a robot; `robot` returns its number at each message."""
        kind = PoseWithCovarianceStamped
        topic = f"{namespace}{INITIAL_POSE}"
        return self._node.create_subscription(
            kind, topic, partial(self._take, robot), qos.COMMAND
        )

    def _look(self) -> None:
        if self._shown is None and not self._map.get_subscription_count():
            return
        world = self._node.device
        simulator = world.simulator
        member = int(simulator.data.member[0])
        still = standing(simulator.sampler, member, simulator.obstacles[0])
        shown = (
            world,
            member,
            [(shape, tuple(np.asarray(pose))) for shape, pose in still],
        )
        if shown != self._shown:
            self._shown = shown
            grid = occupancy(simulator.world.members[member], still, self._cell)
            self._map.publish(
                conversions.map_to_ros(grid, self._node.now_ns, self._frame)
            )

    def _take(
        self, robot: Callable[[], int], message: PoseWithCovarianceStamped
    ) -> None:
        logger = self._node.get_logger()
        simulator = self._node.device.simulator
        try:
            pose = read_initial_pose(message, self._frame)
            x1, y1, x2, y2 = simulator.world.members[
                int(simulator.data.member[0])
            ].extent
            if not (x1 <= pose[0] <= x2 and y1 <= pose[1] <= y2):
                where = f"x {x1:g} to {x2:g} m, y {y1:g} to {y2:g} m"
                place = f"x {pose[0]:.2f} m, y {pose[1]:.2f} m"
                raise ConfigError(
                    f"{INITIAL_POSE}: {place} is outside the world ({where})."
                )
        except ConfigError as error:
            logger.error(f"{error} The robot stays where it is.")
            return
        simulator.put_robot(robot(), pose, np.zeros(simulator.data.state.shape[-1]))
        self._node.device.put(robot())
        logger.info(
            f"the robot was put at ({pose[0]:.2f}, {pose[1]:.2f}) m, {pose[2]:.2f} rad"
        )
