"""Parameters of Nav2's controller server that a policy in its place follows."""

import math
from collections.abc import Sequence
from itertools import chain
from typing import Any

from rclpy.node import Node

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2.follow import GoalCheck, ProgressCheck
from nics_drl_bridge.nodes.parameters import list_checker_rows
from nics_drl_bridge.nodes.runner import declare_row, declare_rows, get_text

# Parameters for Nav2's own plugins, or for a control loop; a policy answers scans instead.
UNUSED = {
    "controller_frequency",
    "min_x_velocity_threshold",
    "min_y_velocity_threshold",
    "min_theta_velocity_threshold",
    "use_realtime_priority",
    "odom_topic",
    "odom_duration",
    "publish_zero_velocity",
    "introspection_mode",
    "bond_heartbeat_period",
    "action_server_result_timeout",
    "allow_parameter_qos_overrides",
}


KINDS = ("controller", "goal_checker", "progress_checker", "path_handler")


class ControllerParameters:
    """The names of controllers, checkers and path handlers, and the checks of a name."""

    def __init__(self, node: Node) -> None:
        self._node = node
        values = declare_rows(node, "nav2")
        self.names = {kind: tuple(values[f"{kind}_plugins"] or ()) for kind in KINDS}
        empty = [kind for kind, names in self.names.items() if not names]
        if empty:
            raise ConfigError(
                f"parameter '{empty[0]}_plugins' is empty; give one name or more."
            )
        checker = values["progress_checker_plugin"]
        if checker:
            self.names["progress_checker"] = (checker,)
        for group in ("goal_checker", "progress_checker"):
            for row in list_checker_rows(group, self.names[group]):
                declare_row(node, row)

    def checks(self, goal: str, progress: str) -> tuple[GoalCheck, ProgressCheck]:
        """Return the checks of two names; they act like Nav2's checkers of the chosen plugins."""
        arrives = self._filled(GoalCheck, goal)
        gets_on = self._filled(ProgressCheck, progress)
        kinds = [get_text(self._node, f"{name}.plugin") for name in (goal, progress)]
        if kinds[0].endswith(("PositionGoalChecker", "AxisGoalChecker")):
            arrives = arrives._replace(yaw_goal_tolerance=math.inf)
        if not kinds[1].endswith("PoseProgressChecker"):
            gets_on = gets_on._replace(required_movement_angle=math.inf)
        return arrives, gets_on

    def _filled(self, kind: Any, name: str) -> Any:
        names = [f"{name}.{field}" for field in kind._fields]
        return kind(*(self._node.get_parameter(field).value for field in names))

    def ignores(self, name: str) -> bool:
        """True for a parameter of Nav2's own controller that means nothing to a policy."""
        return name in UNUSED or name.split(".")[0] in chain(*self.names.values())


def choose_plugin(kind: str, name: str, known: Sequence[str]) -> str:
    """Return a plugin's name; an empty one selects the only plugin. Raises ConfigError."""
    if not name and len(known) == 1:
        return known[0]
    if name not in known:
        what = kind.replace("_", " ")
        names = ", ".join(map(repr, known))
        raise ConfigError(f"there is no {what} {name!r}; name one of {names}.")
    return name
