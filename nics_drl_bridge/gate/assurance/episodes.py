"""Episodes behind a gate in process, with randomly drawn realistic delays."""

from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge.gate.assurance.place import Job, Outcome, Place
from nics_drl_bridge.gate.gate_loop import Gate, Witness
from nics_drl_bridge.gate.inputs import Command, Input, Odometry, Scan
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import Decision, GateConfig, replace
from nics_drl_bridge.gate.stopping import make_gate_config, shield_config
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array

# maximum delay of a scan to the gate, and of the command after it [s]
MAX_SCAN_DELAY_S = 0.29
# maximum delay of the gate's command to the base, including the gate's own pauses [s]
MAX_COMMAND_DELAY_S = 0.1
# This fraction of the data is late by up to the episode's maximum, the rest by up to a
# fifth of it.
HURRIED = 0.25


class Delays:
    """Draws the delays of data; later data never overtake earlier ones."""

    def __init__(self, rng: np.random.Generator, max_steps: float) -> None:
        self._rng = rng
        self._last = 0
        self._max_steps = rng.uniform(0.0, max_steps)

    def draw_arrival(self, step: int) -> int:
        """Returns the step at which something arrives that is sent at a step."""
        share = 1.0 if self._rng.random() < HURRIED else 0.2
        delay = round(self._rng.uniform(0.0, self._max_steps * share))
        self._last = max(self._last, step + delay)
        return self._last


def configure_gate(
    model: SimulatorModel,
    limits: str | Path,
    overrides: Mapping[str, float] | None = None,
    shielded: bool = True,
) -> GateConfig:
    """Returns the configuration that `command_gate` uses; `overrides` are shield values."""
    command_limits = load_limits(limits, model.robot)
    shield = None
    if shielded:
        shield, _ = shield_config(model, command_limits, limits, overrides)
    return make_gate_config(
        model,
        command_limits,
        shield,
        e_stop_required=False,
        estimate_required=False,
        odom_rate=model.lidar.rate,
    )


class _Traffic:
    """Data and commands between robot, policy, gate and base, each late by its own delays."""

    def __init__(self, place: Place, job: Job) -> None:
        rng = np.random.default_rng([11, job.seed, *place.model.robot.name.encode()])
        self._place = place
        self._to_gate = Delays(rng, MAX_SCAN_DELAY_S / place.step_s)
        self._behind = Delays(rng, MAX_COMMAND_DELAY_S / place.step_s)
        self._to_base = Delays(rng, MAX_COMMAND_DELAY_S / place.step_s)
        self._data: deque[tuple[int, Input]] = deque()
        self._commands: deque[tuple[int, Command]] = deque()
        self._twists = deque([(0, np.zeros(3))])

    def send(self, step: int, now: float) -> None:
        """Sends the robot's data at a time [s], and the policy's command after them."""
        place = self._place
        truth = place.truth
        lidar = place.model.lidar
        stamp = round(now * NS_PER_S)
        arrival = self._to_gate.draw_arrival(step)
        angles = (lidar.angle_min, lidar.angle_increment)
        odometry = Odometry(stamp, place.odom.copy(), truth.twist)
        scan = Scan(stamp, truth.ranges, angles)
        self._data += [(arrival, odometry), (arrival, scan)]
        command = Command(stamp, place.wish(truth))
        self._commands.append((self._behind.draw_arrival(arrival), command))

    def receive_all(self, step: int) -> Iterator[Input]:
        """Yields what has arrived by a step: data first, then commands."""
        queues: tuple[deque[Any], ...] = (self._data, self._commands)
        for queue in queues:
            while queue and queue[0][0] <= step:
                yield queue.popleft()[1]

    def pass_on(self, step: int, twist: Array) -> Array:
        """Sends a twist (3,) to the base; returns the one that it follows at a step."""
        self._twists.append((self._to_base.draw_arrival(step + 1), twist))
        while len(self._twists) > 1 and self._twists[1][0] <= step:
            self._twists.popleft()
        return self._twists[0][1]


def drive(
    place: Place, config: GateConfig | None, job: Job, witness: Witness | None = None
) -> Outcome:
    """Drives an episode with its own gate, or without one if `config` is None.

    Without a gate, commands go to the base, and the witness sees them as decisions.
    """
    place.odom = np.zeros(3)
    place.begin(job)
    gate = None
    begun = 0.0
    if config is not None:
        gate = Gate(config, place.model.lidar)
        gate.witness = witness
        gate.arm(place.truth.ranges, place.odom)
        begun = gate.now
    traffic = _Traffic(place, job)
    decision = Decision(np.zeros(3), publish=True, cause=None)
    step = 0
    while not place.ended:
        now = begun + step * place.step_s
        if step % place.period_steps == 0:
            traffic.send(step, now)
        if gate is not None:
            gate.now = now
            for event in traffic.receive_all(step):
                gate.give(event)
            decision = gate.tick()
        else:
            for event in traffic.receive_all(step):
                if isinstance(event, Command):
                    decision = replace(decision, twist=event.twist)
            if witness is not None:
                witness(decision, now)
        place.step(traffic.pass_on(step, decision.twist))
        step += 1
    if gate is not None and gate.state.latched is not None:
        place.outcome.latched = gate.state.latched.rule
    return place.outcome
