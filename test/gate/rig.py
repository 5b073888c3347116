"""A robot around the gate, on a clock of its own: what it sends, and what the gate says."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np

from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import (
    Arm,
    Command,
    Estimate,
    EStop,
    Odometry,
    Scan,
    Tick,
)
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import GateConfig, begin
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.robot.spec import load_robot

LIDAR = load_lidar("paper")
TICK_S = 0.02
PERIOD_S = 0.1
START_STAMP = 1_700_000_000 * NS_PER_S


def config(robot: str = "ackermann", **changes) -> GateConfig:
    spec = load_robot(robot)
    return replace(
        GateConfig(
            fields=tuple(np.flatnonzero(spec.to_cmd_vel(np.ones(len(spec.command))))),
            limits=load_limits(robot, spec),
            beam_angles=LIDAR.angles,
            mount=LIDAR.mount,
            range_min=LIDAR.range_min,
            range_max=LIDAR.range_max,
            scan_rate=10.0,
            odom_rate=10.0,
            stop_when_held=False,  # its scans do not show how it moves
        ),
        **changes,
    )


class Rig:
    """Everything is as it should be, unless a test says otherwise.

    Attributes:
        speed: what odometry shows, along x [m/s].
        wish: (3,) what the policy sends.
        frozen: whether the scans stay the same.
        covariance: (3, 3) of the estimated pose.
        tick_s: between two ticks of the gate [s].
    """

    tick_s = TICK_S

    def __init__(self, given: GateConfig | None = None) -> None:
        self.config = given or config()
        self.state = begin(self.config)
        self.now = 100.0
        self.ticks = 0
        self.stamp = START_STAMP
        self.pose = np.zeros(3)
        self.speed = 0.0
        self.covariance = np.diag([1e-4, 1e-4, 1e-4])  # of the estimate
        self.wish = np.array([0.5, 0.0, 0.1])
        self.frozen = False
        self.ranges = np.linspace(1.0, 2.0, LIDAR.beams, dtype=np.float32)
        self.decision = None
        self.published = []

    def give(self, event, now=None):
        """One input, and the decision about it."""
        now = self.now if now is None else now
        self.state, self.decision = decide(self.config, self.state, event, now)
        if self.decision.publish:
            self.published.append((now, self.decision.twist))
        return self.decision

    def scan(self, **changes):
        if not self.frozen:
            self.ranges = (self.ranges + np.float32(1e-3)).astype(np.float32)
        event = Scan(
            self.stamp, self.ranges.copy(), (LIDAR.angle_min, LIDAR.angle_increment)
        )
        return self.give(replace(event, **changes))

    def odom(self, **changes):
        twist = np.array([self.speed, 0.0, 0.0])
        return self.give(
            replace(Odometry(self.stamp, self.pose.copy(), twist), **changes)
        )

    def command(self, twist=None, stamp=None):
        twist = self.wish if twist is None else np.array(twist, dtype=np.float64)
        return self.give(Command(self.stamp if stamp is None else stamp, twist))

    def tick(self):
        return self.give(Tick())

    def run(self, seconds: float, without: str = ""):
        """Lets time pass; topics named in `without` are silent."""
        for _ in range(round(seconds / self.tick_s)):
            self.now += self.tick_s
            self.ticks += 1
            self.pose = self.pose + np.array([self.speed * self.tick_s, 0.0, 0.0])
            if self.ticks % round(PERIOD_S / self.tick_s) == 0:
                self.send(without)
            self.tick()
        return self.decision

    def send(self, without: str = ""):
        """What arrives in a period."""
        self.stamp += round(PERIOD_S * NS_PER_S)
        if "odom" not in without:
            self.odom()
        if "scan" not in without:
            self.scan()
        if "estimate" not in without:
            twist = np.array([self.speed, 0.0, 0.0])
            self.give(Estimate(twist, self.pose.copy(), self.covariance.copy()))
        if "e_stop" not in without:
            self.give(EStop(False))
        if "command" not in without:
            self.command(
                stamp=self.state.scans.stamps_ns[-1] if self.state.scans.times else 0
            )

    def arm(self, publishers: int = 1):
        return self.give(Arm(publishers))

    def settle(self):
        """Settles and is armed."""
        self.run(1.5)
        assert self.arm().granted, self.decision.answer
        return self

    def drive(self, seconds: float = 1.0):
        """Settles, is armed, and drives as told."""
        self.settle().run(0.04)
        self.speed = float(self.wish[0])
        self.run(seconds)
        assert self.decision.cause is None, self.decision.cause
        assert self.moves
        return self

    @property
    def moves(self) -> bool:
        return bool(self.decision.twist.any())

    @property
    def rule(self) -> str:
        return "" if self.decision.cause is None else self.decision.cause.rule

    def until_stopped(self, limit: float, without: str = "") -> float:
        """Runs until the output is zero; how long that took [s]."""
        began = self.now
        while self.moves:
            assert self.now - began < limit, f"still moves after {limit} s"
            self.run(TICK_S, without)
        return self.now - began


@cache
def _driven() -> Rig:
    return Rig().drive()


def driving(**changes) -> Rig:
    """A gate that is armed and lets a robot drive."""
    return Rig(config(**changes)).drive() if changes else deepcopy(_driven())
