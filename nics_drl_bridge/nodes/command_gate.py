"""command_gate: passes the policy's commands on while they can be trusted."""

import math
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import inputs, scan_motion, shield
from nics_drl_bridge.gate.black_box import Entry
from nics_drl_bridge.gate.e_stop_queue import EStopQueue
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.limits import PERIOD_S, Limits, load_limits
from nics_drl_bridge.gate.state import (
    Decision,
    GateConfig,
    ShieldConfig,
    begin,
    replace,
)
from nics_drl_bridge.gate.stopping import (
    make_gate_config,
    require_possible,
    shield_config,
    warn_of_age_limit,
)
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.middleware.measurement import CMD_VEL, ODOM, SCAN
from nics_drl_bridge.nodes import (
    command_types,
    gate_inputs,
    parameters,
    qos,
    runner,
    wire,
)
from nics_drl_bridge.nodes.conversions import find_sensor_type
from nics_drl_bridge.nodes.gate_inputs import TWIST, TWIST_STAMPED, Sources
from nics_drl_bridge.nodes.gate_log import GateLog
from nics_drl_bridge.nodes.own_process import take_priority

SIM_TIME = "use_sim_time"
FOREIGN = "foreign_commands"
SPLIT = {  # parameters of earlier versions, and what replaced them
    "estimate_std": "'estimate_position' [m] and 'estimate_heading' [rad], which limit how much "
    "the estimate's uncertainty grows within 10 s, counted from arming",
}
FOREIGN_SETTINGS = {
    command_types.TWIST: f"{FOREIGN}:={TWIST}",
    command_types.TWIST_STAMPED: f"{FOREIGN}:={TWIST_STAMPED}",
}
# maximum age of a decision; an older one is made again [s]
STALE_S = 0.05
# default age limit of a command's scan for a slow lidar, in scan periods
SCAN_PERIODS = 1.75


def declare_gate(node: Node, model: SimulatorModel) -> GateConfig:
    """Declare and read a gate's parameters, and log doubts. Raises ConfigError for a bad value."""
    given = qos.get_given_values(node)
    for name in sorted(SPLIT.keys() & given.keys()):
        raise ConfigError(f"parameter {name!r}: is now {SPLIT[name]}.")
    rules = parameters.list_gate_rules(
        odom_rate=1.0 / model.control_period,
        scan_age=max(GateConfig.scan_age_s, SCAN_PERIODS / model.lidar.rate),
    )
    values = {}
    for row in rules:
        field = row.name
        if hasattr(GateConfig, f"{field}_s"):
            field = f"{field}_s"
        values[field] = runner.declare_row(node, row)
    runner.declare_rows(node, "gate", "stamped")
    file = runner.get_text(node, "limits")
    limits = load_limits(file, model.robot) if file else None
    config = make_gate_config(
        model,
        limits,
        _read_shield(node, model, limits, file),
        simulated=runner.get_flag(node, SIM_TIME),
        odom_rate_declared="odom_rate" in given,
        **values,
    )
    node.add_on_set_parameters_callback(partial(_keep_clock, config.simulated))
    require_possible(config)
    doubt = warn_of_age_limit(config, model.control_period)
    if doubt:
        node.get_logger().warning(doubt)
    return config


def _keep_clock(simulated: bool, parameters: list[Parameter]) -> SetParametersResult:
    """Refuse a change of `use_sim_time`: the rules were derived for the clock at the start."""
    for parameter in parameters:
        if parameter.name == SIM_TIME and parameter.value != simulated:
            reason = (
                f"parameter {SIM_TIME!r} can't be changed while the gate runs; restart it with `-p "
                f"{SIM_TIME}:={str(not simulated).lower()}`."
            )
            return SetParametersResult(successful=False, reason=reason)
    return SetParametersResult(successful=True)


def find_black_box(node: Node) -> Path:
    """Return the folder for recordings of stops of a node in its namespace."""
    folder = runner.get_text(node, "black_box")
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    # A gate in another namespace must not remove its files.
    return (Path(folder) if folder else home / "black_box") / str(
        node.get_namespace()
    ).strip("/")


def _read_shield(
    node: Node, model: SimulatorModel, limits: Limits | None, file: str
) -> ShieldConfig | None:
    values = {}
    for name in ("latency", "deceleration", "margin", "obstacle_speed"):
        value = runner.get_number(node, f"shield_{name}")
        if not math.isnan(value):
            values[name] = value
    if not runner.get_flag(node, "shield"):
        node.get_logger().warning("the shield is off: obstacles do not stop the robot")
        return None
    config, sentence = shield_config(model, limits, file, values)
    node.get_logger().info(sentence)
    return config


class CommandGate(qos.BridgeNode):
    """The node between `cmd_vel_raw` and `cmd_vel`; it has its own process and starts disarmed."""

    def __init__(self, **options: Any) -> None:
        super().__init__("command_gate", **options)
        model = runner.declare_model(self)
        logger = self.get_logger()
        self._lidar = model.lidar
        self._config = declare_gate(self, model)
        self._sensors = model.sensors
        self._state = begin(self._config)
        self._log = GateLog(
            self._config, find_black_box(self), model.robot.name, logger
        )
        if not self._config.e_stop_required:
            logger.warning(
                "e_stop_required is false: the robot moves even if e_stop was never received. "
                "That is for simulations; set it on a vehicle."
            )
        if self._config.shield is not None:
            shield.warm_up()
        scan_motion.warm_up(self._config)
        self._stamped = runner.get_flag(self, parameters.STAMPED)
        self._frame = runner.get_text(self, parameters.BASE_FRAME)
        fault = parameters.find_frame_fault(
            self.get_parameters_by_prefix("").values(), parameters.BASE_FRAME
        )
        if fault:
            raise ConfigError(fault)
        kind = command_types.KINDS[command_types.name_of(self._stamped)]
        self._out = self.create_publisher(kind, CMD_VEL, qos.COMMAND)
        self._queue = EStopQueue()
        self._listen()
        runner.call_periodically(self, PERIOD_S, self._tick)
        runner.diagnose(self, "gate", self._look)
        refused = take_priority(self.get_parameter("priority").value)
        if refused:  # once all threads exist
            logger.warning(refused)

    def _listen(self) -> None:
        # first, because an executor takes waiting messages in the order of subscriptions
        self._button = self.create_lossless_subscription(
            Bool,
            inputs.E_STOP,
            self._take_e_stop,
            qos.E_STOP,
            lost=lambda count: self._decide(
                inputs.Press(f"{count} messages were lost, and may have been a press")
            ),
        )
        kinds = ("none", TWIST, TWIST_STAMPED)
        raw = runner.get_choice(self, FOREIGN, kinds)
        raw_kind = command_types.name_of(stamped=raw != TWIST)
        command_types.TypeWatch(self, inputs.RAW, raw_kind, FOREIGN_SETTINGS)
        readers: tuple[tuple[Any, str, Callable[[bytes], inputs.Input], Any], ...] = (
            (LaserScan, SCAN, partial(gate_inputs.read_scan, self._lidar), qos.SENSOR),
            (Odometry, ODOM, self._read_odometry, qos.SENSOR),
            (Odometry, inputs.ESTIMATE, gate_inputs.read_estimate, qos.SENSOR),
            *(
                (
                    find_sensor_type(sensor),
                    sensor.name,
                    partial(gate_inputs.read_sensor, sensor),
                    qos.SENSOR,
                )
                for sensor in self._sensors
            ),
        )
        for kind, topic, read, profile in readers:
            taker = partial(self._take, topic, read)
            self.create_subscription(kind, topic, taker, profile, raw=True)
        commands = self.create_subscription(
            command_types.KINDS[raw_kind],
            inputs.RAW,
            partial(self._take_command, raw),
            qos.EVERY_COMMAND,
            raw=True,
        )
        self._sources = Sources(self, commands.topic_name)
        count = partial(self.count_publishers, self._out.topic_name)
        runner.serve(self, "~/arm", lambda: self._answer(inputs.Arm(count())))
        runner.serve(self, "~/reset", lambda: self._answer(inputs.Reset()))
        runner.serve(self, "~/e_stop", self._press)

    def _take(
        self, topic: str, read: Callable[[bytes], inputs.Input], content: bytes
    ) -> None:
        try:
            event = read(content)
        except wire.UNREADABLE as error:  # the middleware uses another encoding
            self._log.refuse(topic, f"{topic}: {error}")
        else:
            self._decide(event)

    def _take_command(self, raw: str, content: bytes, info: Mapping[str, Any]) -> None:
        def read(content: bytes) -> inputs.Command:
            if raw == "none":
                command = gate_inputs.read_command(content)
            else:
                age_ns = round(self._config.command_age_s * NS_PER_S)
                oldest_ns = int(self.get_clock().now().nanoseconds) - age_ns
                command = gate_inputs.read_foreign_command(
                    raw, oldest_ns, self._state.scan, content
                )
            source = self._sources.name_of(info)
            publishers = self._sources.publishers
            return replace(command, source=source, publishers=publishers)

        self._take(inputs.RAW, read, content)

    def _take_e_stop(self, content: bytes) -> None:
        """Decide on all waiting messages; a press comes first, so that it waits for no other."""
        contents = [content, *qos.take_waiting(self._button)]
        self._queue.add(time.monotonic(), len(contents))
        messages = []
        for part in contents:
            try:
                messages.append(gate_inputs.read_e_stop(part))
            except wire.UNREADABLE as error:
                self._log.refuse(inputs.E_STOP, f"{inputs.E_STOP}: {error}")
                self._decide(
                    inputs.Press("a message could not be read, and may be a press")
                )
        if any(message.pressed for message in messages):
            self._decide(inputs.EStop(True))
        if messages:
            self._decide(messages[-1])

    def _tick(self) -> None:
        reason = self._queue.tick(time.monotonic())
        if reason:
            self._decide(inputs.Press(reason))
        self._decide(inputs.Tick())

    def _read_odometry(self, content: bytes) -> inputs.Odometry:
        event = gate_inputs.read_odometry(content)
        if not self._frame:  # no parameter names it
            self._frame = wire.read_frames(content)[1]
        return event

    def _press(self) -> tuple[bool, str]:
        self._decide(inputs.Press())
        return True, "the e-stop is pressed; ~/reset releases it"

    def _answer(self, event: inputs.Input) -> tuple[bool, str]:
        decision = self._decide(event)
        self.get_logger().info(f"{type(event).__name__.lower()}: {decision.answer}")
        return decision.granted, decision.answer

    def _decide(self, event: inputs.Input) -> Decision:
        now = time.monotonic()
        before = self._state
        self._state, decision = decide(self._config, before, event, now)
        # Publish first: the rest is not urgent.
        instead = self._say(decision, now) if decision.publish else None
        self._log.note(Entry(now, event, before, decision))
        if instead is not None and not isinstance(event, inputs.Press):
            self._decide(instead)
        return decision

    def _say(self, decision: Decision, now: float) -> inputs.Input | None:
        # Apart from `stop`, this is the only path to the robot. The clock is read immediately
        # before sending: if the process was frozen since the decision, the motion is not sent.
        content = self._message(decision.twist)
        if not np.isfinite(decision.twist).all():
            self._out.publish(self._message(np.zeros(3)))
            self._log.report_not_finite(decision.twist.tolist())
            return inputs.Press()
        if decision.cause is None and time.monotonic() - now > STALE_S:
            return inputs.Tick()
        self._out.publish(content)
        return None

    def _message(self, twist: Array) -> bytes:
        if not self._stamped:
            return wire.write_twist(twist)
        now_ns = int(self.get_clock().now().nanoseconds)
        return wire.write_stamped_twist(twist, now_ns, self._frame)

    def _look(self) -> runner.Condition:
        self._sources.count_publishers()
        condition = self._log.finding(self._state)
        others = self.count_publishers(self._out.topic_name) - 1
        if others < 1:
            return condition
        warning = f"others publish on cmd_vel too ({others}) and bypass this gate"
        self.get_logger().warning(warning, throttle_duration_sec=10.0)
        level = max(condition.level, runner.WARN)
        return condition._replace(
            message=f"{condition.message}; {warning}", level=level
        )

    def stop(self) -> None:
        """Leave a zero command behind."""
        runner.publish_last(self._out, self._message(np.zeros(3)))
        self._log.close()


main = partial(runner.run_node, CommandGate, sole_name="command_gate")
