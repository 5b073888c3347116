"""simulator_node: the fast simulator, or another one, behind the topics of the hardware."""

import heapq
import itertools
import math
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, cast

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import SetBool

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.lidar.scanner import RENDERERS, Renderer
from nics_drl_bridge.lidar.spec import to_device
from nics_drl_bridge.middleware.measurement import CMD_VEL
from nics_drl_bridge.nodes import (
    conversions,
    device_parameters,
    parameters,
    qos,
    runner,
    wire,
)
from nics_drl_bridge.nodes.command_types import KINDS, TypeWatch, name_of
from nics_drl_bridge.nodes.conversions import find_sensor_type, sensor_to_ros
from nics_drl_bridge.nodes.frames import compute_odom_in_map, transform_to_ros
from nics_drl_bridge.nodes.link import EPISODE_NS, get_fingerprints
from nics_drl_bridge.nodes.message_packages import explain_install
from nics_drl_bridge.nodes.parts import open_parts
from nics_drl_bridge.nodes.runner import OK, WARN
from nics_drl_bridge.nodes.world_topics import WorldTopics
from nics_drl_bridge.pacing import RealTime, TopicPace
from nics_drl_bridge.sim.device import LEAST_VARIANCE, DeviceWorld, Sensed, variances
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

CLOCK = "/clock"
CLOCK_NS = 15_000_000  # longest time between two ticks of it in real time
WATCH_S = 2.0  # between two checks for other publishers of /clock
QUIET_S = 5.0  # between two equal warnings
LAGGING_S = 5.0  # diagnostics warn for this long after it fell behind real time
PART = "simulator"  # end of its name in diagnostics
# longest time between two checks for delayed data that are due [s]
LONGEST_TICK_S = 0.005

# Makes the simulator of some robots; it may declare parameters at the node. The control period is
# the model's.
MakeSimulator = Callable[[Node, SimulatorModel, AnyWorld, int], FastSimulator]


class Outbox:
    """Publishes messages after a latency and a jitter, or at once; each topic keeps its order."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._waiting: list[tuple[int, int, Publisher, bytes]] = []
        self._latest: dict[Publisher, int] = {}
        self._numbers = itertools.count()

    def send(
        self, publisher: Publisher, message: Any, now_ns: int, late: tuple[int, int]
    ) -> None:
        """Publish a message or its bytes after a delay and a random fraction of a jitter [ns]."""
        delay, jitter = late
        if jitter:
            delay += int(self._random.integers(jitter + 1))
        if not delay:
            publisher.publish(message)
            return
        due = max(now_ns + delay, self._latest.get(publisher, 0))
        self._latest[publisher] = due
        content = message if isinstance(message, bytes) else serialize_message(message)
        heapq.heappush(self._waiting, (due, next(self._numbers), publisher, content))

    def flush(self, now_ns: int) -> None:
        """Publish what is due."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            _, _, publisher, content = heapq.heappop(self._waiting)
            publisher.publish(content)

    def drop(self, publishers: Collection[Publisher]) -> None:
        """Drop the waiting messages of publishers that are about to end."""
        self._waiting = [
            waiting for waiting in self._waiting if waiting[2] not in publishers
        ]
        heapq.heapify(self._waiting)
        for publisher in publishers:
            self._latest.pop(publisher, None)

    def clear(self) -> None:
        """Drop all waiting messages, because their episode is over."""
        self._waiting.clear()
        self._latest.clear()


class RobotPort:
    """Publishes `scan`, `odom`, further sensors, `joint_states`, `ground_truth` of one robot."""

    def __init__(
        self,
        node: "DeviceNode",
        name: str,
        take: Callable[["RobotPort", Array], None],
    ) -> None:
        self._node = node
        self._model = model = node.model
        self.name = name.strip("/") or model.robot.name
        self.frames = frames = device_parameters.get_frames(node, name.strip("/"))
        self.namespace = namespace = f"{name}/" if name else ""
        self._publishers: list[Publisher] = []
        self.inlet = CommandInlet(node, namespace, partial(take, self))
        self.command_ns = 0  # time of the newest command
        self.has_command = False  # in lock-step: since the last step
        self._joint_writer = conversions.JointWriter(model.robot)
        timing = node.timing
        self._send = partial(node.outbox.send, late=timing.odom_late_ns)
        self._send_scan = partial(node.outbox.send, late=timing.scan_late_ns)

        def publisher(kind: Any, topic: str) -> Publisher:
            made = node.create_publisher(
                kind, f"{namespace}{topic}", qos.SENSOR_RELIABLE
            )
            self._publishers.append(made)
            return made

        self._scans = publisher(LaserScan, "scan")
        self._odoms = publisher(Odometry, "odom")
        self._truths = publisher(Odometry, "ground_truth")
        self._joints = publisher(JointState, "joint_states")
        self._sensors = [
            (
                sensor,
                frames.prefix + sensor.frame,
                publisher(find_sensor_type(sensor), sensor.name),
            )
            for sensor in model.sensors
        ]
        free = np.full(model.lidar.beams, np.inf, np.float32)
        scan = conversions.scan_to_ros(model.lidar, free, 0, frames.laser)
        scan.scan_time = timing.scan_ns / NS_PER_S
        # A device that turns counter-clockwise measures beam 0 first.
        sweep_s = max(0.0, scan.time_increment) * (model.lidar.beams - 1)
        self._sweep_ns = 0 if timing.lockstep else round(sweep_s * NS_PER_S)
        self._scan = wire.ScanWriter(scan)
        linear, _, turn = variances(model.noise.odometry)
        odom = (LEAST_VARIANCE, LEAST_VARIANCE, linear, turn)
        truth = (LEAST_VARIANCE,) * 4
        at_rest = partial(conversions.odometry_to_ros, np.zeros(3), np.zeros(3), 0)
        self._odom = wire.OdometryWriter(at_rest((frames.odom, frames.base), odom))
        self._truth = wire.OdometryWriter(at_rest((frames.map, frames.base), truth))
        self._locates = runner.get_flag(node, "publish_map_to_odom")

    def close(self) -> None:
        """End its topics."""
        self.inlet.close()
        self._node.outbox.drop(self._publishers)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def mounts(self) -> list[TransformStamped]:
        """Return the transforms base_link -> laser, to each further sensor, and footprint."""
        mounted = [(self.frames.laser, self._model.lidar.mount)]
        mounted += [(frame, sensor.mount) for sensor, frame, _ in self._sensors]
        if self.frames.footprint:
            mounted.append((self.frames.footprint, (0.0, 0.0, 0.0)))
        base = self.frames.base
        return [transform_to_ros(base, frame, place, 0) for frame, place in mounted]

    def moving(self, now_ns: int, sensed: Sensed) -> list[TransformStamped]:
        """Return the transforms odom -> base_link, and map -> odom if requested."""
        frames = self.frames
        moving = [transform_to_ros(frames.odom, frames.base, sensed.odom, now_ns)]
        if self._locates:
            home = compute_odom_in_map(sensed.pose, sensed.odom)
            moving.append(transform_to_ros(frames.map, frames.odom, home, now_ns))
        return moving

    def publish_odometry(self, sensed: Sensed, now_ns: int) -> None:
        """Publish odometry, and joints and true pose if they have subscribers."""
        odometry = self._odom.write(
            now_ns, sensed.odom, sensed.twist, sensed.covariance
        )
        self._send(self._odoms, odometry, now_ns)
        if self._joints.get_subscription_count():
            joints = self._joint_writer.write(sensed.state, now_ns)
            self._send(self._joints, joints, now_ns)
        if self._truths.get_subscription_count():
            self._truths.publish(
                self._truth.write(now_ns, sensed.pose, sensed.true_twist)
            )

    def publish_scan(self, sensed: Sensed, now_ns: int) -> None:
        """Publish the scan, stamped with the time of beam 0, and readings of further sensors."""
        ranges = to_device(sensed.ranges, self._model.lidar)
        self._send_scan(
            self._scans, self._scan.write(now_ns - self._sweep_ns, ranges), now_ns
        )
        for sensor, frame, publisher in self._sensors:
            reading = sensor_to_ros(sensor, sensed.readings[sensor.name], now_ns, frame)
            self._send_scan(publisher, reading, now_ns)


class CommandInlet:
    """Listens to `cmd_vel`, stamped or not, and to `ackermann_cmd` if the robot steers."""

    def __init__(
        self,
        node: "DeviceNode",
        namespace: str,
        take: Callable[[Array], None],
    ) -> None:
        self._node = node
        self._robot = robot = node.model.robot
        self._take = take
        quality = qos.EVERY_COMMAND if node.timing.lockstep else qos.COMMAND
        stamped = runner.get_flag(node, "enable_stamped_cmd_vel")
        self._hear = partial(self._on_bytes, stamped)
        kind = name_of(stamped)
        self._commands = node.create_subscription(
            KINDS[kind], f"{namespace}{CMD_VEL}", self._hear, quality, raw=True
        )
        self._topic = self._commands.topic_name
        self.heard = [self._commands]
        self._types = TypeWatch(node, self._topic, kind)
        drive = conversions.find_message_type(
            "ackermann_msgs/msg/AckermannDriveStamped"
        )
        if robot.steers and drive is not None:  # its package is optional
            topic = f"{namespace}ackermann_cmd"
            self.heard.append(
                node.create_subscription(drive, topic, self._on_ackermann, quality)
            )

    def close(self) -> None:
        """End the subscriptions."""
        self._types.close()
        for subscription in self.heard:
            self._node.destroy_subscription(subscription)

    def take_waiting(self) -> None:
        """Take the commands that have arrived but are not handled yet."""
        for content in qos.take_waiting(self._commands):
            self._hear(content)

    def _on_bytes(self, stamped: bool, content: bytes) -> None:
        stamp_ns = 0
        try:
            if stamped:
                stamp_ns = wire.read_stamp(content)
                twist = wire.read_stamped_twist(content)
            else:
                twist = wire.read_twist(content)
        except wire.UNREADABLE as error:
            self._complain(f"a message that can't be read ({error}) is ignored")
            return
        if self._is_fresh(stamp_ns):
            self._obey(twist)

    def _obey(
        self,
        twist: Sequence[float],
        read: Callable[[Sequence[float]], Array] | None = None,
    ) -> None:
        if all(map(math.isfinite, twist)):
            self._take((read or self._robot.from_cmd_vel)(twist))
        else:
            self._complain("NaN or inf ignored")

    def _on_ackermann(self, message: Any) -> None:
        if self._is_fresh(conversions.stamp_from_ros(message.header.stamp)):
            angle = message.drive.steering_angle
            self._obey((message.drive.speed, 0.0, angle), self._robot.from_fields)

    def _is_fresh(self, stamp_ns: int) -> bool:
        if not stamp_ns or not self._node.is_too_old(stamp_ns):
            return True
        why = "its stamp is older than command_timeout; do both ends use one clock (use_sim_time)?"
        self._complain(f"a command is ignored, because {why}")
        return False

    def _complain(self, what: str) -> None:
        self._node.get_logger().warning(
            f"{self._topic}: {what}", throttle_duration_sec=QUIET_S
        )


class DeviceNode(qos.BridgeNode):
    """Takes `cmd_vel`; publishes `scan`, `odom`, `joint_states`, `ground_truth`, `/clock`, `/tf`.

    The parameter `robots` makes a fleet, with each robot in a namespace below the node's. Simulated
    time starts at the system time and never runs backwards. `~/reset` begins an episode. In
    lock-step the world moves once each robot has a command; `~/repeat` publishes the present data
    again.
    """

    def __init__(self, name: str, make: MakeSimulator, **options: Any) -> None:
        super().__init__(name, **options)
        model = runner.declare_model(self)
        device_parameters.declare_device(self, model.lidar.frame)
        self.timing = device_parameters.get_timing(self, model)
        self._names = parameters.name_fleet(self.get_parameter("robots").value)
        self._given = model
        self.model = device_parameters.apply_timing(self, model, self.timing)
        self._make = make
        self.use_world(load_worlds(runner.get_text(self, "world")))
        self.paused = False
        self._lags = 0
        self._lagged_s = -math.inf  # last time that it fell behind, on the steady clock
        self._hardware = model.robot.name
        self._told_ns = 0  # newest time on `/clock`
        self.device.advance()  # compiles before any peer waits
        self._first_ns = time.time_ns() // self.timing.step_ns * self.timing.step_ns
        self.now_ns = self._first_ns
        self._open_topics()
        self._start_time()
        # its entities include those of the first episode
        self._parts = open_parts("device", self)
        self.begin()

    def use_world(self, world: AnyWorld) -> None:
        """Simulate a world with the robots of the start; call `begin` next."""
        simulator = self.make_simulator(world, len(self._names))
        self.world = world
        self.device = DeviceWorld(simulator, self.model, len(self._names))
        self._identity = get_fingerprints(
            self._given, world, device_parameters.get_randomisation(self)
        )

    def make_simulator(self, world: AnyWorld, robots: int) -> FastSimulator:
        """Make a simulator of a world for M robots. Raises ConfigError."""
        return self._make(self, self.model, world, robots)

    @property
    def robot_names(self) -> tuple[str, ...]:
        """Namespace of each robot of the start; for a single robot its name."""
        return tuple(name or self.model.robot.name for name in self._names)

    @property
    def map_frame(self) -> str:
        """Frame of the world."""
        return runner.get_text(self, "map_frame")

    @property
    def frames(self) -> list[device_parameters.Frames]:
        """Frames of each robot."""
        return [port.frames for port in self._ports]

    def _open_topics(self) -> None:
        self.outbox = Outbox()
        self._clock_topic = self.create_publisher(Clock, CLOCK, qos.SENSOR_RELIABLE)
        self._clocks = {self.get_fully_qualified_name()}
        self._ports: list[RobotPort] = []
        self._world_topics = WorldTopics(self)
        for name in self._names:
            self._open_robot(name)
        self._open_transforms()
        runner.serve(self, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        runner.serve(self, "~/repeat", self._repeat)
        runner.serve(self, "~/touched", self._list_touched)
        self.create_service(SelfTest, "~/self_test", self._test)
        runner.diagnose(self, PART, self._look)

    def _open_robot(self, name: str) -> None:
        port = RobotPort(self, name, self._on_command)
        port.inlet.heard.append(
            self._world_topics.hear(port.namespace, lambda: self._ports.index(port))
        )
        self._ports.append(port)

    def add_robot(self, namespace: str) -> None:
        """Open the topics of the robot that was added to the device last."""
        self._open_robot(namespace)
        self._publish_mounts()

    def reopen_robots(self) -> None:
        """Open the topics of exactly the robots of the start."""
        self.remove_robots(range(len(self._ports)))
        for name in self._names:
            self._open_robot(name)
        self._publish_mounts()

    def remove_robots(self, gone: Sequence[int]) -> None:
        """Close the topics of robots that have left the device."""
        for port in [self._ports[k] for k in gone]:
            port.close()
            self._ports.remove(port)
        self._complete.trigger()  # not here: more robots may be about to leave

    def _open_transforms(self) -> None:
        self._transforms: Any = conversions.transforms_type()
        if self._transforms is None:
            silent = "so neither /tf nor /tf_static is published"
            fix = explain_install("tf2_msgs")
            self.get_logger().warning(
                f"the package tf2_msgs is not installed, {silent}; {fix}."
            )
            return
        self._moving = self.create_publisher(self._transforms, "/tf", qos.TRANSFORMS)
        self._fixed = self.create_publisher(self._transforms, "/tf_static", qos.LATCHED)
        self._publish_mounts()

    def _publish_mounts(self) -> None:
        if self._transforms is not None:
            mounts = itertools.chain.from_iterable(
                port.mounts() for port in self._ports
            )
            self._fixed.publish(self._transforms(transforms=list(mounts)))

    def _start_time(self) -> None:
        # On the steady clock: with use_sim_time the node's clock would wait for this very node.
        runner.call_periodically(self, WATCH_S, self._watch)
        step_ns = self.timing.step_ns
        self._odom_pace = TopicPace(self.timing.odom_ns, step_ns)
        self._scan_pace = TopicPace(self.timing.scan_ns, step_ns)
        self._real_time = RealTime(step_ns, self.timing.rate)
        self._timer = None
        self._soon = self.create_guard_condition(self._on_time)
        self._complete = self.create_guard_condition(self._advance_if_complete)
        if self.timing.mode == parameters.REALTIME:
            period = step_ns / NS_PER_S / self.timing.rate
            # If data are published later than measured, use a tick that divides the step.
            late = any((*self.timing.scan_late_ns, *self.timing.odom_late_ns))
            ticks = max(1.0, np.ceil(period / LONGEST_TICK_S)) if late else 1.0
            self._timer = runner.call_periodically(self, period / ticks, self._on_time)
            if period * NS_PER_S > CLOCK_NS:
                runner.call_periodically(self, CLOCK_NS / NS_PER_S, self._on_clock)
        elif not self.timing.lockstep:
            runner.call_periodically(
                self, 0.0, lambda: None if self.paused else self.step()
            )

    def _watch(self) -> None:
        names = set(qos.list_owners(self.get_publishers_info_by_topic(CLOCK)))
        for name in names - self._clocks:
            self.get_logger().warning(
                f"{name} publishes {CLOCK} too, and nodes with use_sim_time hear both; give each "
                "simulator a ROS_DOMAIN_ID of its own, or let one run all robots (`robots`)."
            )
        self._clocks |= names

    def _look(self) -> runner.Condition:
        facts = {
            "mode": self.timing.mode,
            "rate": self.timing.rate,
            "robots": len(self._names),
            "simulated time [s]": f"{self.now_ns / NS_PER_S:.3f}",
            "times it fell behind real time": self._lags,
            EPISODE_NS: self._episode_ns,
            **self._identity,
        }
        for port, touched in zip(self._ports, self.device.touched, strict=True):
            facts[f"touched, {port.name}"] = touched
        message = "paused" if self.paused else "running"
        level = OK
        if time.monotonic() - self._lagged_s < LAGGING_S:
            message = "behind real time"
            level = WARN
        return runner.Condition(message, level, facts, self._hardware)

    def _test(
        self, _: SelfTest.Request, response: SelfTest.Response
    ) -> SelfTest.Response:
        """Report what is simulated and since when; passes unless a robot touched something."""
        response.id = self._hardware
        response.passed = bytes([not any(self.device.touched)])
        response.status = [runner.status_to_ros(self, PART, self._look())]
        return response

    def _list_touched(self) -> tuple[bool, str]:
        touched = zip(self._ports, self.device.touched, strict=True)
        names = [port.name for port, has_touched in touched if has_touched]
        return True, f"touched something: {', '.join(names) or 'nobody'}"

    def is_too_old(self, stamp_ns: int) -> bool:
        """Return whether a command of a time [ns] has timed out; in lock-step none does."""
        timeout_ns = int(runner.get_number(self, "command_timeout") * NS_PER_S)
        return not self.timing.lockstep and self.now_ns - stamp_ns > timeout_ns

    def _on_command(self, port: RobotPort, command: Array) -> None:
        if port not in self._ports:  # its robot has left since the command arrived
            return
        robot = self._ports.index(port)
        self.device.commands[robot] = command
        port.command_ns = self.now_ns
        if self.timing.lockstep and not self.paused:
            port.has_command = True
            self._advance_if_complete()

    def _advance_if_complete(self) -> None:
        """In lock-step, move the world once all present robots have a command."""
        complete = all(port.has_command for port in self._ports)
        if self.timing.lockstep and not self.paused and complete and self._ports:
            self.advance()

    def _on_time(self) -> None:
        if self.paused:
            return
        steady_ns = time.monotonic_ns()
        if self._real_time.lost(steady_ns, self.now_ns):
            self._lags += 1
            self._lagged_s = time.monotonic()
            fix = "choose a lower rate, scan_rate or odom_rate, or fewer robots"
            warning = f"this machine does not keep up with real time; {fix}"
            self.get_logger().warning(warning, throttle_duration_sec=5.0)
            self._real_time.begin(steady_ns, self.now_ns + self.timing.step_ns)
        behind = self._real_time.behind(steady_ns, self.now_ns)
        if behind:
            self.advance()
        if behind > 1:
            self._soon.trigger()  # not here: commands that have arrived are for the next step
        self.outbox.flush(max(self.now_ns, self._real_time.time_at(steady_ns)))

    def _on_clock(self) -> None:
        """Publish the time between two steps, which may be too far apart for timers on `/clock`."""
        if self.paused:
            return
        time_ns = self._real_time.time_at(time.monotonic_ns())
        between_ns = min(time_ns, self.now_ns + self.timing.step_ns - 1)
        if self._told_ns < between_ns:
            self._tell_time(between_ns)

    def _tell_time(self, time_ns: int) -> None:
        self._told_ns = time_ns
        if self._clock_topic.get_subscription_count():
            self._clock_topic.publish(Clock(clock=conversions.stamp_to_ros(time_ns)))

    def advance(self) -> None:
        """Move the world by one step, and publish what is due."""
        for k, port in enumerate(self._ports):
            port.has_command = False
            if self.is_too_old(port.command_ns):
                self.device.commands[k] = 0.0
        self.device.advance()
        self.now_ns += self.timing.step_ns
        self._publish()

    def begin(self, rewind: bool = False) -> None:
        """Begin the episode of the parameters; if `rewind`, set time back to its start."""
        seed = int(self.get_parameter("episode_seed").value)
        # comes first: if it raises, the present episode goes on
        self.device.begin(seed, device_parameters.get_episode_start(self))
        if rewind:
            self.now_ns = self._first_ns
        for port in self._ports:
            port.has_command = False
        self.now_ns += self.timing.step_ns
        self._episode_ns = self.now_ns
        self._publish_after_jump()

    def rewind(self) -> None:
        """Set the time back to its start; nothing moves."""
        for port in self._ports:  # keep the age of the commands
            port.command_ns += self._first_ns - self.now_ns
        self.now_ns = self._first_ns
        self._publish_after_jump()

    def _publish_after_jump(self) -> None:
        """Publish all topics after the time or the world has jumped."""
        self.outbox.clear()
        self._odom_pace.begin(self.now_ns)
        self._scan_pace.begin(self.now_ns)
        self._go_on()
        self._publish()

    def step(self) -> None:
        """Move the world by one step, even while paused, and publish what is due."""
        self.advance()
        self.outbox.flush(self.now_ns)

    def pause(self, paused: bool) -> None:
        """Pause or resume time."""
        self.paused = paused
        if not paused:
            self._go_on()

    def _go_on(self) -> None:
        self._real_time.begin(time.monotonic_ns(), self.now_ns)
        if self._timer is not None:
            self._timer.reset()

    def _reset(self) -> tuple[bool, str]:
        # The executor may serve a request before a command that was sent earlier. In lock-step that
        # command would move the world of the new episode.
        for port in self._ports:
            port.inlet.take_waiting()
        try:
            self.begin()
        except BridgeError as error:
            return False, str(error)
        return True, f"an episode began at {self._episode_ns / NS_PER_S:.3f} s"

    def _on_pause(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self.pause(bool(request.data))
        response.success = True
        response.message = "paused" if self.paused else "running"
        return response

    def _repeat(self) -> tuple[bool, str]:
        if not self.timing.lockstep:
            return False, "data are only repeated in lock-step"
        self._publish_data(odom_due=True, scan_due=True)
        return True, ""

    def _publish(self) -> None:
        now_ns = self.now_ns
        self._tell_time(now_ns)
        odom_due = self._odom_pace.due(now_ns)
        scan_due = self._scan_pace.due(now_ns)
        if odom_due or scan_due:
            self._publish_data(odom_due, scan_due)

    def _publish_data(self, odom_due: bool, scan_due: bool) -> None:
        now_ns = self.now_ns
        moving = []
        for k, port in enumerate(self._ports):
            sensed = self.device.sensed(k)
            if odom_due:
                port.publish_odometry(sensed, now_ns)
                if self._transforms is not None:
                    moving += port.moving(now_ns, sensed)
            if scan_due:
                port.publish_scan(sensed, now_ns)
        if moving:  # with the delay of the odometry behind it
            message = self._transforms(transforms=moving)
            self.outbox.send(self._moving, message, now_ns, self.timing.odom_late_ns)


def declare_renderer(node: Node, default: Renderer) -> Renderer:
    """Declare the parameter `renderer`, and return its value."""
    runner.declare_row(node, parameters.make_renderer_row(default))
    return cast(Renderer, device_parameters.get_choice(node, "renderer", RENDERERS))


def make_fast_simulator(
    node: Node, model: SimulatorModel, world: AnyWorld, robots: int
) -> FastSimulator:
    """Make the fast simulator with the lidar renderer that the parameter `renderer` names."""
    renderer = declare_renderer(node, defaults.RENDERER)
    warn = node.get_logger().warning
    drawn = device_parameters.get_randomisation(node)
    options: Any = {"renderer": renderer, "randomisation": drawn, "warn": warn}
    return FastSimulator(model, world, robots=robots, **options)


SimulatorNode = partial(DeviceNode, "simulator_node", make_fast_simulator)
main = partial(runner.run_node, SimulatorNode, sole_name="simulator_node")
