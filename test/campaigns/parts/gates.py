"""A gate in process, on a clock that the benchmark holds, with a robot that sends all it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Arm, Command, Input, Odometry, Reset, Scan, Tick
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import Decision, GateConfig, begin
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]
Witness = Callable[[Decision, float], None]
START_S = 1000.0
SETTLE_PERIODS = 12


def gate_config(robot: RobotSpec, lidar: LidarSpec, **changes: object) -> GateConfig:
    """The gate of a shipped robot, without emergency stop and middleware around it."""
    given = GateConfig(
        fields=tuple(
            int(i)
            for i in np.flatnonzero(robot.to_cmd_vel(np.ones(len(robot.command))))
        ),
        limits=load_limits(robot.name, robot),
        beam_angles=lidar.angles,
        mount=lidar.mount,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        scan_rate=lidar.rate,
        odom_rate=lidar.rate,
        e_stop_required=False,
        estimate_required=False,
    )
    return replace(given, **changes)  # type: ignore[arg-type]


class Gate:
    """Holds the state of a gate from one input to the next.

    Attributes:
        now: steady time [s].
        stamp_ns: of the newest data [ns].
        witness: sees every decision, with its time.
    """

    def __init__(self, config: GateConfig, lidar: LidarSpec) -> None:
        self.config = config
        self._lidar = lidar
        self.witness: Witness | None = None
        self.state = begin(config)
        self.now = START_S
        self.stamp_ns = NS_PER_S

    def give(self, given: Input) -> Decision:
        """One input now."""
        self.state, decision = decide(self.config, self.state, given, self.now)
        if self.witness is not None:
            self.witness(decision, self.now)
        return decision

    def sense(self, ranges: NDArray[np.float32], pose: Array, twist: Array) -> None:
        """Odometry and a scan arrive."""
        self.stamp_ns = round(self.now * NS_PER_S)
        angles = (self._lidar.angle_min, self._lidar.angle_increment)
        self.give(Odometry(self.stamp_ns, pose.copy(), twist.copy()))
        self.give(Scan(self.stamp_ns, ranges.copy(), angles))

    def command(self, twist: Array) -> Decision:
        """A command computed from the newest scan arrives."""
        return self.give(Command(self.stamp_ns, twist))

    def tick(self) -> Decision:
        """The clock ticks."""
        return self.give(Tick())

    def arm(self, ranges: NDArray[np.float32], pose: Array) -> None:
        """Stands still until it may be armed, and is."""
        self.give(Reset())
        for _ in range(SETTLE_PERIODS):
            self.now += 1.0 / self._lidar.rate
            self.sense(ranges, pose, np.zeros(3))
            self.tick()
        decision = self.give(Arm(1))
        if not decision.granted:
            raise RuntimeError(f"the gate can't be armed: {decision.answer}")
