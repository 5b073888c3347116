"""An action server whose goals are held until something else ends them; and their results."""

from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Duration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node

from nics_drl_bridge.interface import NS_PER_S

SUCCEED, ABORT, CANCELED = "succeed", "abort", "canceled"


class HeldActionServer(ActionServer):
    """Accepts goals while `open_` says so, and hands each to `begin`, until `finish` ends it.

    None is waited for in a callback: rclpy polls what waits, in every turn of an executor.
    """

    def __init__(
        self, node: Node, kind: Any, name: str, open_: Callable[[], bool],
        begin: Callable[[Any], None],
    ) -> None:  # fmt: skip
        self._begin = begin
        accept, reject = GoalResponse.ACCEPT, GoalResponse.REJECT
        super().__init__(
            node, kind, name, lambda _: None,
            goal_callback=lambda _: accept if open_() else reject,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )  # fmt: skip

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Holds an accepted goal, which counts as executing from now on; see rclpy."""
        self._begin(goal_handle)

    def finish(self, goal_handle: Any, end: str, result: Any) -> None:
        """Ends a goal, by the name of a method of it, with a result."""
        getattr(goal_handle, end)()
        super().notify_execute(goal_handle, lambda _: result)


def duration_to_ros(seconds: float) -> Duration:
    """Returns seconds as a Duration."""
    whole = int(seconds)
    return Duration(sec=whole, nanosec=int((seconds - whole) * NS_PER_S))


def result_of(kind: Any, code: str, sentence: str = "") -> Any:
    """Returns an action's result; distributions differ in what it tells: nothing, code, or both."""
    result = kind.Result()
    if hasattr(result, "error_code"):
        result.error_code = getattr(kind.Result, code, getattr(kind.Result, "UNKNOWN", 0))
    if hasattr(result, "error_msg"):
        result.error_msg = sentence
    return result
