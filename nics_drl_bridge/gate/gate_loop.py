"""A gate in process, on a clock that its owner controls."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import Arm, Command, Input, Odometry, Reset, Scan, Tick
from nics_drl_bridge.gate.state import Decision, GateConfig, begin
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.spec import LidarSpec

Witness = Callable[[Decision, float], None]  # receives each decision and its time [s]
START_S = 1000.0
SETTLE_PERIODS = 12  # scans before arming


class Gate:
    """Keeps the state of a gate from one input to the next."""

    def __init__(self, config: GateConfig, lidar: LidarSpec) -> None:
        self.config = config
        self._lidar = lidar
        self.witness: Witness | None = None  # sees every decision
        self.state = begin(config)
        self.now = START_S  # steady time [s]
        self.stamp_ns = NS_PER_S  # of the newest data

    def give(self, event: Input) -> Decision:
        """Decides on an input now."""
        self.state, decision = decide(self.config, self.state, event, self.now)
        if self.witness is not None:
            self.witness(decision, self.now)
        return decision

    def sense(self, ranges: NDArray[np.float32], pose: Array, twist: Array) -> None:
        """Gives the gate odometry and a scan."""
        self.stamp_ns = round(self.now * NS_PER_S)
        angles = (self._lidar.angle_min, self._lidar.angle_increment)
        self.give(Odometry(self.stamp_ns, pose.copy(), twist.copy()))
        self.give(Scan(self.stamp_ns, ranges.copy(), angles))

    def command(self, twist: Array) -> Decision:
        """Gives the gate a command that was computed from the newest scan."""
        return self.give(Command(self.stamp_ns, twist))

    def tick(self) -> Decision:
        """Advances the gate's clock by a tick."""
        return self.give(Tick())

    def arm(self, ranges: NDArray[np.float32], pose: Array) -> None:
        """Keeps the robot at rest until the gate can be armed, and arms it.

        Raises BackendError if it can't be armed.
        """
        self.give(Reset())
        for _ in range(SETTLE_PERIODS):
            self.now += 1.0 / self._lidar.rate
            self.sense(ranges, pose, np.zeros(3))
            self.tick()
        decision = self.give(Arm(1))
        if not decision.granted:
            raise BackendError(f"the gate can't be armed: {decision.answer}.")
