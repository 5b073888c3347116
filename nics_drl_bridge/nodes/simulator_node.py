"""simulator_node: a simulator, the fast one or another, behind the topics of the hardware."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import cast

import numpy as np
from rclpy.context import Context
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array, Simulator
from nics_drl_bridge.lidar.scanner import RENDERERS, Renderer
from nics_drl_bridge.nodes import conversions, device_parameters, qos, runner
from nics_drl_bridge.nodes.device_parameters import RealTime, TopicPace, declare_device, number
from nics_drl_bridge.nodes.device_robot import CommandInlet, Outbox, RobotPort, Transforms
from nics_drl_bridge.nodes.qos import QosWatch, owner
from nics_drl_bridge.sim.device import DeviceWorld
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World, load_world

CLOCK = "/clock"
WATCH_S = 2.0
LONGEST_TICK_S = 0.005  # longest time between two checks for delayed data that are due [s]

MakeSimulator = Callable[[Node, SimulatorModel, World, int], Simulator]
"""Makes the simulator of a number of robots; may declare its own parameters at the node. Its
control period is that of the given model."""


class DeviceNode(QosWatch):
    """Takes `cmd_vel`; publishes `scan`, `odom`, `joint_states`, `ground_truth`, `/clock`, `/tf`.

    With the parameter `robots` it is a fleet in one world, each robot in a namespace below the
    node's own. Stamps are simulated time, as on `/clock`: it begins at the system's time and never
    runs backwards, not even at a reset. `~/reset` begins the episode of the parameters
    `episode_seed` and `episode_start`; its answer is JSON with the stamp of the first data. In
    lock-step the world moves when each robot has a command, and `~/repeat` publishes its present
    data again. `~/touched` reports which robots have truly touched something in this episode.
    """

    def __init__(self, name: str, context: Context, make: MakeSimulator) -> None:
        super().__init__(name, context=context)
        model = runner.declare_model(self)
        declare_device(self, model.lidar.frame)
        self._time = device_parameters.timing(self, model)
        self._names = device_parameters.namespaces(self)
        world = load_world(str(self.get_parameter("world").value))
        self._identity = {"model": model.fingerprint, "world": world.fingerprint}
        model = device_parameters.timed_model(self, model, self._time)
        simulator = make(self, model, world, len(self._names))
        self._world = DeviceWorld(simulator, model, len(self._names))
        self._command_ns = np.zeros(len(self._names), np.int64)
        self._heard = np.zeros(len(self._names), np.bool_)
        self._paused, self._lags, self._hardware = False, 0, model.robot.name
        self._world.advance()  # compiles before anything waits for it
        self._now_ns = time.time_ns() // self._time.step_ns * self._time.step_ns
        self._open_topics(model)
        self._start_time()
        self._begin()

    def _open_topics(self, model: SimulatorModel) -> None:
        self._outbox = Outbox()
        self._clock_topic = self.create_publisher(Clock, CLOCK, qos.SENSOR_RELIABLE)
        self._clocks = {self.get_fully_qualified_name()}
        self._transforms = Transforms(self)
        self._ports, self._inlets = [], []
        commands = qos.EVERY_COMMAND if self._time.lockstep else qos.COMMAND
        for k, name in enumerate(self._names):
            space, frames = f"{name}/" if name else "", device_parameters.frames(self, name)
            self._ports.append(RobotPort(self, space, model, frames, self._time))
            given = model.robot, commands, partial(self._on_command, k), self._too_old
            self._inlets.append(CommandInlet(self, space, *given))
        self._transforms.publish_fixed([port.mount() for port in self._ports])
        runner.serve(self, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        runner.serve(self, "~/repeat", self._repeat)
        runner.serve(self, "~/touched", lambda: (True, json.dumps(self._world.touched)))
        runner.Diagnostics(self, "simulator", self._look)

    def _start_time(self) -> None:
        # Steady: with use_sim_time the node's clock would wait for this very node.
        runner.steadily(self, WATCH_S, self._watch)
        step_ns = self._time.step_ns
        self._odom_pace, self._scan_pace = (
            TopicPace(period_ns, step_ns) for period_ns in (self._time.odom_ns, self._time.scan_ns)
        )
        self._real_time = RealTime(step_ns, self._time.rate)
        self._timer = None
        self._soon = self.create_guard_condition(self._on_time)
        if self._time.mode == "realtime":
            period = step_ns / NS_PER_S / self._time.rate
            # A tick that divides the step, if data are published later than they are measured.
            late = any((*self._time.scan_late_ns, *self._time.odom_late_ns))
            ticks = max(1.0, np.ceil(period / LONGEST_TICK_S)) if late else 1.0
            self._timer = runner.steadily(self, period / ticks, self._on_time)
        elif not self._time.lockstep:
            runner.steadily(self, 0.0, self._on_free_time)

    def _watch(self) -> None:
        """Warns once of commands of another type, and of other nodes that publish the time."""
        for inlet in self._inlets:
            inlet.watch()
        ends = self.get_publishers_info_by_topic(CLOCK)
        names = {name for end in ends if (name := owner(end)) is not None}
        for name in names - self._clocks:
            self.get_logger().warning(
                f"{name} publishes {CLOCK} too, and nodes with use_sim_time hear both; give each "
                "simulator a ROS_DOMAIN_ID of its own, or let one run all robots (`robots`)."
            )
        self._clocks |= names

    def _look(self) -> runner.Condition:
        facts = {
            "mode": self._time.mode, "rate": self._time.rate, "robots": len(self._names),
            "simulated time [s]": f"{self._now_ns / NS_PER_S:.3f}",
            "times it fell behind real time": self._lags, **self._identity,
        }  # fmt: skip
        message = "paused" if self._paused else "running"
        return runner.Condition(message, False, facts, self._hardware)

    def _timeout_ns(self) -> int:
        return int(number(self, "command_timeout") * NS_PER_S)

    def _too_old(self, stamp_ns: int) -> bool:
        return not self._time.lockstep and self._now_ns - stamp_ns > self._timeout_ns()

    def _on_command(self, robot: int, command: Array) -> None:
        self._world.commands[robot], self._command_ns[robot] = command, self._now_ns
        if self._time.lockstep and not self._paused:
            self._heard[robot] = True
            if self._heard.all():
                self._advance()

    def _on_time(self) -> None:
        if self._paused:
            return
        steady_ns = time.monotonic_ns()
        if self._real_time.lost(steady_ns, self._now_ns):
            self._lags += 1
            self.get_logger().warning(
                "this machine does not keep up with real time; ask for a smaller rate, scan_rate "
                "or odom_rate, or fewer robots",
                throttle_duration_sec=5.0,
            )
            self._real_time.begin(steady_ns, self._now_ns + self._time.step_ns)
        behind = self._real_time.behind(steady_ns, self._now_ns)
        if behind:
            self._stop_the_silent()
            self._advance()
        if behind > 1:
            self._soon.trigger()  # not here: commands that have arrived are for the next step
        self._outbox.flush(max(self._now_ns, self._real_time.time_at(steady_ns)))

    def _on_free_time(self) -> None:
        if not self._paused:
            self._stop_the_silent()
            self._advance()
            self._outbox.flush(self._now_ns)

    def _stop_the_silent(self) -> None:
        self._world.commands[self._now_ns - self._command_ns > self._timeout_ns()] = 0.0

    def _advance(self) -> None:
        self._world.advance()
        self._heard[:] = False
        self._now_ns += self._time.step_ns
        self._publish()

    def _begin(self) -> None:
        """Begins an episode. Raises BridgeError if the parameters do not fit the world."""
        given = bool(self.get_parameter("episode_start_given").value)
        start = np.array(self.get_parameter("episode_start").value, dtype=np.float64)
        self._world.begin(int(number(self, "episode_seed")), start if given else None)
        self._outbox.clear()
        self._heard[:] = False
        self._now_ns += self._time.step_ns
        self._odom_pace.begin(self._now_ns)
        self._scan_pace.begin(self._now_ns)
        self._go_on()
        self._publish()

    def _go_on(self) -> None:
        """Restarts real time at the present."""
        self._real_time.begin(time.monotonic_ns(), self._now_ns)
        if self._timer is not None:
            self._timer.reset()

    def _reset(self) -> tuple[bool, str]:
        try:
            self._begin()
        except BridgeError as error:
            return False, str(error)
        return True, json.dumps({"stamp_ns": self._now_ns, **self._identity})

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = bool(request.data)
        if not self._paused:
            self._go_on()
        response.success, response.message = True, "paused" if self._paused else "running"
        return response

    def _repeat(self) -> tuple[bool, str]:
        """Publishes the present data again, if some were lost; in real time new ones follow."""
        if not self._time.lockstep:
            return False, "data are repeated in lock-step alone"
        self._publish_data(odom_due=True, scan_due=True)
        return True, ""

    def _publish(self) -> None:
        """Publishes what is due at present."""
        now_ns = self._now_ns
        if self._clock_topic.get_subscription_count():
            self._clock_topic.publish(Clock(clock=conversions.stamp_to_ros(now_ns)))
        odom_due, scan_due = self._odom_pace.due(now_ns), self._scan_pace.due(now_ns)
        if odom_due or scan_due:
            self._publish_data(odom_due, scan_due)

    def _publish_data(self, odom_due: bool, scan_due: bool) -> None:
        """Publishes the present data of the robots' devices."""
        now_ns, outbox, moving = self._now_ns, self._outbox, []
        for k, port in enumerate(self._ports):
            sensed = self._world.sensed(k)
            if odom_due:
                port.publish_odometry(sensed, outbox, now_ns)
                if self._transforms.published:
                    moving += port.moving(conversions.stamp_to_ros(now_ns), sensed)
            if scan_due:
                port.publish_scan(sensed, outbox, now_ns)
        if moving:
            self._transforms.publish(moving, outbox, now_ns, self._time.odom_late_ns)


def fast_simulator(node: Node, model: SimulatorModel, world: World, robots: int) -> Simulator:
    """Makes the fast simulator, with the lidar that the parameter `renderer` names."""
    runner.declare(node, "renderer", "baked", "Lidar: baked or exact.", read_only=True)
    renderer = cast(Renderer, device_parameters.choice(node, "renderer", RENDERERS))
    tell = node.get_logger().warning
    return FastSimulator(model, world, robots=robots, renderer=renderer, tell=tell)


def simulator_node(context: Context) -> DeviceNode:
    """Makes the node `simulator_node`; see `DeviceNode`."""
    return DeviceNode("simulator_node", context, fast_simulator)


main = partial(runner.run_node, simulator_node, sole_name="simulator_node")
