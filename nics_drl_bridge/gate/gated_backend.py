"""A backend behind the gate and its shield, in process and on the clock of the simulated world."""

from typing import Any

import numpy as np

from nics_drl_bridge import interface
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.gate.state import Decision, GateConfig, begin, replace
from nics_drl_bridge.gate.stopping import make_gate_config, shield_config
from nics_drl_bridge.generator import SimulatorModel

FIRST_NS = interface.NS_PER_S  # the clock at the beginning of an episode


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
        self._period_ns = round(model.control_period * interface.NS_PER_S)
        self._config = make_gate_config(
            model,
            command_limits,
            shield,
            e_stop_required=False,
        )
        if not self._period_ns * interface.S_PER_NS < GateConfig.gap_s:
            slow = f"commands come every {model.control_period:g} s, and it stops after"
            raise ConfigError(
                f"the gate can't be simulated: {slow} {GateConfig.gap_s:g} s."
            )

    def reset(self, start: interface.Start) -> interface.RobotView:
        """Begins the episode of a seed; see `interface.Backend`."""
        # A person arms the gate beforehand; that time is not simulated.
        self._state = replace(begin(self._config), armed=True)
        self._now_ns = FIRST_NS
        return self._pass_on(self._backend.reset(start))

    def step(
        self, command: interface.Array
    ) -> tuple[interface.RobotView, dict[str, Any]]:
        """Applies the gate's output for a command for one period; see `interface.Backend`."""
        robot = self._model.robot
        self._give(inputs.Command(self._now_ns, robot.to_cmd_vel(command)))
        decision = self._give(inputs.Tick())
        view, facts = self._backend.step(robot.from_cmd_vel(decision.twist))
        self._now_ns += self._period_ns
        cause = "" if decision.cause is None else decision.cause.rule
        return self._pass_on(view), {
            **facts,
            "stopped_by": cause,
            "shielded": decision.shielded,
        }

    def _pass_on(self, view: interface.RobotView) -> interface.RobotView:
        lidar = self._model.lidar
        now = self._now_ns
        self._give(inputs.Odometry(now, view.pose.copy(), view.twist.copy()))
        for sensor in self._model.sensors:
            points = sensor.points(view.sensed[sensor.name])
            self._give(inputs.SensorReading(now, sensor.name, points))
        angles = lidar.angle_min, lidar.angle_increment
        self._give(inputs.Scan(now, view.ranges.astype(np.float32, copy=True), angles))
        return view

    def _give(self, event: inputs.Input) -> Decision:
        now = self._now_ns * interface.S_PER_NS
        self._state, decision = decide(self._config, self._state, event, now)
        return decision

    def facts(self) -> interface.BackendFacts:
        """Returns those of the backend behind the gate; see `interface.Backend`."""
        return self._backend.facts()

    def halt(self) -> None:
        """Stops the robot; see `interface.Backend`."""
        self._backend.halt()

    def close(self) -> None:
        """Stops the robot and frees all resources; see `interface.Backend`."""
        self._backend.close()
