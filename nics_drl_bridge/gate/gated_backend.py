"""A backend behind the gate and its shield, in process and on the clock of the simulated world."""

from typing import Any

import numpy as np

from nics_drl_bridge import interface
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.gate_loop import Gate
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import GateConfig, replace
from nics_drl_bridge.gate.stopping import make_gate_config, shield_config
from nics_drl_bridge.generator import SimulatorModel


class GatedBackend:
    """Passes commands on as `command_gate` would, armed at the beginning of each episode.

    The gate decides once at the beginning of each control period, from the robot's view
    and the command. Limits are a shipped file or a YAML file, which may include the
    shield. In `info`, `stopped_by` is the rule that stopped a command, or "", and
    `shielded` is True if the shield reduced it.
    """

    def __init__(
        self, backend: interface.Backend, model: SimulatorModel, limits: str
    ) -> None:
        command_limits = load_limits(limits, model.robot)
        shield, _ = shield_config(model, command_limits, limits)
        self._backend = backend
        self._model = model
        self._config = make_gate_config(
            model,
            command_limits,
            shield,
            e_stop_required=False,
        )
        if not model.control_period < GateConfig.gap_s:
            slow = f"commands come every {model.control_period:g} s, and it stops after"
            raise ConfigError(
                f"the gate can't be simulated: {slow} {GateConfig.gap_s:g} s."
            )

    def reset(self, start: interface.Start) -> interface.RobotView:
        """Begins the episode of a seed; see `interface.Backend`."""
        self._gate = Gate(self._config, self._model.lidar)
        # A person arms the gate beforehand; that time is not simulated.
        self._gate.state = replace(self._gate.state, armed=True)
        return self._pass_on(self._backend.reset(start))

    def step(
        self, command: interface.Array
    ) -> tuple[interface.RobotView, dict[str, Any]]:
        """Applies the gate's output for a command for one period; see `interface.Backend`."""
        robot = self._model.robot
        self._gate.command(robot.to_cmd_vel(command))
        decision = self._gate.tick()
        view, facts = self._backend.step(robot.from_cmd_vel(decision.twist))
        self._gate.now += self._model.control_period
        cause = "" if decision.cause is None else decision.cause.rule
        gated = {"stopped_by": cause, "shielded": decision.shielded}
        return self._pass_on(view), {**facts, **gated}

    def _pass_on(self, view: interface.RobotView) -> interface.RobotView:
        ranges = view.ranges.astype(np.float32, copy=False)
        self._gate.sense(ranges, view.pose, view.twist)
        for sensor in self._model.sensors:
            points = sensor.points(view.sensed[sensor.name])
            stamp_ns = self._gate.stamp_ns
            self._gate.give(inputs.SensorReading(stamp_ns, sensor.name, points))
        return view

    def facts(self) -> interface.BackendFacts:
        """Returns those of the backend behind the gate; see `interface.Backend`."""
        return self._backend.facts()

    def halt(self) -> None:
        """Stops the robot; see `interface.Backend`."""
        self._backend.halt()

    def close(self) -> None:
        """Stops the robot and frees all resources; see `interface.Backend`."""
        self._backend.close()
