"""Episodes of the shield in process, as fast as they go: delays are those of a robot, but drawn."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from parts.gates import Gate, Witness, gate_config
from parts.shield_places import SCAN_STEPS, STEP_S, Job, Outcome, Place

from nics_drl_bridge.gate.inputs import Command, Input, Odometry, Scan
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import GateConfig
from nics_drl_bridge.gate.stopping import shield_config
from nics_drl_bridge.interface import NS_PER_S

MOST_SCAN_LATE_S, MOST_TOLD_LATE_S = 0.29, 0.1
"""Greatest delay of a scan, or of the command behind it, to the gate; and of the gate's command to
the base, the gate's own pauses included."""
HURRIED = 0.25
"""One in so many scans is late by up to the most that the episode has; the others by a fifth."""


class Delays:
    """How late what is sent arrives; nothing overtakes what was sent before.

    Args:
        rng: draws them.
        most_s: the greatest [s].
    """

    def __init__(self, rng: np.random.Generator, most_s: float) -> None:
        self._rng = rng
        self._last = 0
        self._most = rng.uniform(0.0, most_s / STEP_S)

    def arrival(self, step: int) -> int:
        """The step at which something arrives that is sent at a step."""
        most = self._most * (1.0 if self._rng.random() < HURRIED else 0.2)
        self._last = max(self._last, step + round(self._rng.uniform(0.0, most)))
        return self._last


def config_of(place: Place, shield: dict[str, float] | None) -> GateConfig:
    """The gate of a place as `command_gate` would set it up.

    Args:
        place: whose robot it guards.
        shield: values that go before the shipped ones; None for no shield.
    """
    robot = place.model.robot
    given = None
    if shield is not None:
        limits = load_limits(place.robot, robot)
        given = shield_config(place.model, limits, place.robot, shield)[0]
    return gate_config(robot, place.model.lidar, shield=given)


def drive(
    place: Place,
    config: GateConfig,
    jobs: Sequence[Job],
    witness: Witness | None = None,
) -> list[Outcome]:
    """Drives episodes one after the other, each with a gate of its own.

    Args:
        place: the robot in its world.
        config: of its gate.
        jobs: the episodes.
        witness: sees every decision of the gates, with its time.
    """
    return [_episode(place, config, job, witness) for job in jobs]


def _episode(
    place: Place, config: GateConfig, job: Job, witness: Witness | None
) -> Outcome:
    place.begin(job)
    gate = Gate(config, place.model.lidar)
    lidar = place.model.lidar
    gate.witness = witness
    truth = place.truth
    gate.arm(truth.ranges, place.odom)
    rng = np.random.default_rng([11, job.seed, *place.model.robot.name.encode()])
    to_gate = Delays(rng, MOST_SCAN_LATE_S)
    behind = Delays(rng, MOST_TOLD_LATE_S)
    to_base = Delays(rng, MOST_TOLD_LATE_S)
    begun = gate.now
    step = 0
    coming: deque[tuple[int, Input]] = deque()
    commands: deque[tuple[int, Command]] = deque()
    told = deque([(0, np.zeros(3))])
    while not place.ended:
        gate.now = begun + step * STEP_S
        if step % SCAN_STEPS == 0:
            truth = place.truth
            stamp = round(gate.now * NS_PER_S)
            seen = to_gate.arrival(step)
            scan = Scan(stamp, truth.ranges, (lidar.angle_min, lidar.angle_increment))
            coming += [
                (seen, Odometry(stamp, place.odom.copy(), truth.twist)),
                (seen, scan),
            ]
            commands.append((behind.arrival(seen), Command(stamp, place.wish(truth))))
        for queue in (coming, commands):
            while queue and queue[0][0] <= step:
                gate.give(queue.popleft()[1])
        told.append((to_base.arrival(step + 1), gate.tick().twist))
        while len(told) > 1 and told[1][0] <= step:
            told.popleft()
        place.step(told[0][1])
        step += 1
    latched = gate.state.latched
    place.outcome.latched = "" if latched is None else latched.rule
    return place.outcome
