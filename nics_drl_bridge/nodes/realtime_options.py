"""What a backend in real time may be told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema

RAW = "cmd_vel_raw"


class RealtimeOptions(Schema):
    """Options of `RealtimeBackend`.

    Attributes:
        namespace: of the robot.
        simulator: name of the simulator's node in that namespace.
        domain_id: DDS domain; the environment's by default.
        timeout_s: how long to wait for a peer or an answer [s].
        vehicle: whether a vehicle is there, which has no services. None looks for them.
        period_s: of a step on the steady clock [s]; the model's control period by default.
        stale_after_s: older data are no view of the robot [s].
        start: of an episode on a vehicle: `wait` until it stands at the asked pose, or take the
            `present` one.
        tolerance: within which it stands there [m, rad].
        start_timeout_s: how long to wait for it [s].
        say: is told what is missing meanwhile; the node's logger by default.
        command_topic: where commands go. `cmd_vel_raw` goes by way of `command_gate`: then each is
            a TwistStamped with the stamp of the scan that it answers.
        stamped: whether `cmd_vel` is a TwistStamped.
        pose_type: type of `pose`, a pose sensor in `map`, or `none`.
        use_imu: whether to use the yaw rate of `imu`.
    """

    namespace: str = ""
    simulator: str = "simulator_node"
    domain_id: int | None = Field(None, ge=0, le=232)
    timeout_s: float = Field(30.0, gt=0.0)
    vehicle: bool | None = None
    period_s: float | None = Field(None, gt=0.0)
    stale_after_s: float = Field(0.5, gt=0.0)
    start: Literal["wait", "present"] = "wait"
    tolerance: tuple[float, float] = (0.1, 0.1)
    start_timeout_s: float = Field(300.0, gt=0.0)
    say: Callable[[str], None] | None = None
    command_topic: str = Field("cmd_vel", min_length=1)
    stamped: bool = False
    pose_type: str = "none"
    use_imu: bool = False

    @model_validator(mode="after")
    def _check(self) -> RealtimeOptions:
        if not all(value > 0.0 for value in self.tolerance):
            raise ValueError("tolerance must be above 0: metres and radians.")
        return self

    @property
    def gated(self) -> bool:
        """Whether commands pass a `command_gate`."""
        return self.command_topic.rsplit("/", 1)[-1] == RAW
