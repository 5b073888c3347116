"""Episodes of the shield in process, as fast as they go: delays are those of a robot, but drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measuring.gates import NANO, Gate, gate_config
from measuring.shield_places import SCAN_STEPS, STEP_S, Job, Outcome, Place
from nics_drl_bridge.safety.inputs import Command, Input, Odometry, Scan
from nics_drl_bridge.safety.limits import load_limits
from nics_drl_bridge.safety.state import GateConfig
from nics_drl_bridge.safety.stopping import shield_config

MOST_STEPS_LATE = 3
"""Greatest delay of a scan to the gate, and of the command behind it; each is drawn."""


def config_of(place: Place, shield: dict[str, float] | None) -> GateConfig:
    """The gate of a place as `command_gate` would set it up.

    Args:
        place: whose robot it guards.
        shield: values that go before the shipped ones; None for no shield.
    """
    robot, given = place.model.robot, None
    if shield is not None:
        limits = load_limits(place.robot, robot)
        given = shield_config(place.model, limits, place.robot, shield)[0]
    return gate_config(robot, place.model.lidar, shield=given)


def drive(place: Place, config: GateConfig, jobs: Sequence[Job]) -> list[Outcome]:
    """Drives episodes one after the other, each with a gate of its own."""
    return [_episode(place, config, job) for job in jobs]


def _episode(place: Place, config: GateConfig, job: Job) -> Outcome:
    place.begin(job)
    gate, lidar = Gate(config, place.model.lidar), place.model.lidar
    truth = place.truth
    gate.arm(truth.ranges, place.odom)
    late = np.random.default_rng([11, job.seed]).integers(0, MOST_STEPS_LATE + 1, 2)
    begun, step, told = gate.now, 0, np.zeros(3)
    coming: list[tuple[int, Input]] = []
    while not place.ended:
        gate.now = begun + step * STEP_S
        if step % SCAN_STEPS == 0:
            truth, stamp, seen = place.truth, round(gate.now * NANO), step + int(late[0])
            scan = Scan(stamp, truth.ranges, (lidar.angle_min, lidar.angle_increment))
            coming += [(seen, Odometry(stamp, place.odom.copy(), truth.twist)), (seen, scan)]
            coming.append((seen + int(late[1]), Command(stamp, place.wish(truth))))
        for when, given in coming:
            if when <= step:
                gate.give(given)
        coming = [each for each in coming if each[0] > step]
        decided = gate.tick().twist
        place.step(told)  # what was decided the tick before is here now
        told, step = decided, step + 1
    latched = gate.state.latched
    place.outcome.latched = "" if latched is None else latched.rule
    return place.outcome
