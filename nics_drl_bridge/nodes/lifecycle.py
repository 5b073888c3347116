"""Base class of the managed nodes: configure, activate, deactivate, cleanup, shutdown."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher

from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.nodes.ending import at_once
from nics_drl_bridge.nodes.parameters import Row, frame_fault, managed, sensors
from nics_drl_bridge.nodes.qos import QosWatch, copied
from nics_drl_bridge.nodes.runner import ACTIVE, INACTIVE, UNCONFIGURED, declare_row

SUCCESS = TransitionCallbackReturn.SUCCESS
FAILURE = TransitionCallbackReturn.FAILURE


class ManagedNode(QosWatch, LifecycleNode):
    """A lifecycle node; `configure` creates its resources and puts their clean-up on `undo`.

    It declares the parameters in `rows`, in addition to those of managed nodes and of sensors.
    """

    def __init__(self, name: str, rows: Sequence[Row], **options: Any) -> None:
        super().__init__(name, **options)
        self.fixed: set[str] = set()
        self.undo = ExitStack()
        values = [declare_row(self, row) for row in (*managed(), *sensors(), *rows)]
        fault = frame_fault(self.get_parameters_by_prefix("").values())
        if fault:
            raise ConfigError(fault)
        self._autostart = bool(values[0])
        # the last primary state
        self.state = UNCONFIGURED
        self._starting = False
        self._failure: Exception | None = None
        self.add_on_set_parameters_callback(self._check_fixed)

    def create_lifecycle_publisher(self, kind: Any, topic: str, qos: Any) -> Publisher:
        """Create a publisher, until clean-up, that is silent unless the node is active."""
        profile = copied(qos)
        options = self.publisher_options(topic, profile)
        made = super().create_lifecycle_publisher(kind, topic, profile, **options)
        self.undo.callback(self.destroy_lifecycle_publisher, made)
        return made

    def configure(self) -> None:
        """Create what the parameters request. Raises BridgeError if one can't be used."""

    def activate(self) -> None:
        """Start to act."""

    def deactivate(self) -> None:
        """Leave the robot at rest; publish nothing afterwards."""

    def start(self) -> None:
        """Configure and activate the node, if `autostart` is set. Raises BridgeError."""
        if not self._autostart:
            self.get_logger().info(
                "unconfigured: waiting for `ros2 lifecycle set` (autostart is false)"
            )
            return
        self._starting = True
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != SUCCESS:
                raise self._failure or BridgeError(
                    f"{self.get_name()} could not be started."
                )
        self._starting = False

    def stop(self) -> None:
        """Leave the robot at rest, from any state."""
        if self.state == ACTIVE:
            self.deactivate()

    def _check_fixed(self, parameters: list[Parameter]) -> SetParametersResult:
        late = sorted(self.fixed & {parameter.name for parameter in parameters})
        reason = frame_fault((*self.get_parameters_by_prefix("").values(), *parameters))
        if late and self.state != UNCONFIGURED:
            lead = f"`ros2 lifecycle set {self.get_fully_qualified_name()} deactivate`"
            fix = f"return it to unconfigured by {lead}, then `cleanup`."
            reason = f"parameter {late[0]!r} is read when the node is configured; {fix}"
        return SetParametersResult(successful=not reason, reason=reason)

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node; a failure leaves it unconfigured."""
        with at_once():  # opening a policy may compile; nothing was commanded yet
            done = self._attempt(self.configure, INACTIVE)
        if done == FAILURE:
            self.undo.close()
        return done

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        super().on_activate(state)  # the publishers
        return self._attempt(self.activate, ACTIVE)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        done = self._attempt(self.deactivate, INACTIVE)
        super().on_deactivate(state)
        return done

    def on_cleanup(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Transition of the state machine."""
        return self._attempt(self.undo.close, UNCONFIGURED)

    def on_shutdown(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Leave the robot at rest, from any state; after an error it can be configured again."""
        self.stop()
        return self._attempt(self.undo.close, UNCONFIGURED)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Act as at a shutdown; the failure is kept for `start`."""
        failure = self._failure
        done = self.on_shutdown(state)
        self._failure = failure
        return done

    def _attempt(
        self, do: Callable[[], None], reached: str
    ) -> TransitionCallbackReturn:
        """Do the work of a transition and report a failure, which rclpy does not."""
        self._failure = None
        try:
            do()
        except Exception as error:
            self._failure = error
            expected = isinstance(error, BridgeError)
            if not self._starting:
                kind = "" if expected else f"{type(error).__name__}: "
                self.get_logger().error(f"{kind}{error}")
            if not expected:
                raise
            return FAILURE
        self.state = reached
        if not self._starting:
            self.get_logger().info("running" if reached == ACTIVE else reached)
        return SUCCESS
