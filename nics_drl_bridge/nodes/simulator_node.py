"""simulator_node: the fast simulator, or another one, behind the topics of the hardware."""

import itertools
import math
import time
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import SetBool

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import BridgeError, ConfigError
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
from nics_drl_bridge.nodes.conversions import (
    INITIAL_POSE,
    find_sensor_type,
    read_initial_pose,
    sensor_to_ros,
)
from nics_drl_bridge.nodes.frames import (
    compute_odom_in_map,
    find_transforms,
    transform_to_ros,
)
from nics_drl_bridge.nodes.link import EPISODE_NS, get_fingerprints
from nics_drl_bridge.nodes.runner import OK, WARN
from nics_drl_bridge.pacing import RealTime, TopicPace
from nics_drl_bridge.recording.messages import get_stamp, read_command
from nics_drl_bridge.sim.device import LEAST_VARIANCE, DeviceWorld, Sensed, variances
from nics_drl_bridge.sim.occupancy import occupancy, standing
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import check_inside
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

CLOCK = "/clock"
CLOCK_NS = 15_000_000  # longest time between two ticks of it in real time
MAP_S = 0.2  # between two checks of what stands in the world
QUIET_S = 5.0  # between two equal warnings
LAGGING_S = 5.0  # diagnostics warn for this long after it fell behind real time
PART = "simulator"  # end of its name in diagnostics
# longest time between two checks for delayed data that are due [s]
LONGEST_TICK_S = 0.005

# Makes the simulator of some robots; it may declare parameters at the node. The control period is
# the model's.
MakeSimulator = Callable[[Node, SimulatorModel, AnyWorld, int], FastSimulator]


class Waiting(NamedTuple):
    """A message that is to be published later."""

    due_ns: int
    publisher: Publisher
    content: bytes


class Outbox:
    """Publishes messages after a latency and a jitter, or at once; each topic keeps its order."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._waiting: list[Waiting] = []

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
        before = (each for each in self._waiting if each.publisher is publisher)
        due_ns = max((now_ns + delay, *(each.due_ns for each in before)))
        content = message if isinstance(message, bytes) else serialize_message(message)
        self._waiting.append(Waiting(due_ns, publisher, content))

    def flush(self, now_ns: int) -> None:
        """Publish what is due."""
        due = [each for each in self._waiting if each.due_ns <= now_ns]
        self._waiting = [each for each in self._waiting if each.due_ns > now_ns]
        for each in sorted(due, key=lambda each: each.due_ns):
            each.publisher.publish(each.content)

    def drop(self, publishers: Collection[Publisher]) -> None:
        """Drop the waiting messages of publishers that are about to end."""
        self._waiting = [w for w in self._waiting if w.publisher not in publishers]

    def clear(self) -> None:
        """Drop all waiting messages, because their episode is over."""
        self._waiting.clear()


class RobotPort:
    """The topics of one robot: takes its commands, and publishes what is sensed."""

    def __init__(self, node: "DeviceNode", name: str) -> None:
        self._node = node
        self._model = model = node.model
        self.name = name.strip("/") or model.robot.name
        self.frames = frames = device_parameters.get_frames(node, name.strip("/"))
        self._namespace = f"{name}/" if name else ""
        self.command_ns = 0  # time of the newest command
        self.has_command = False  # in lock-step: since the last step
        self._publishers: list[Publisher] = []
        self._subscribe()
        self._joint_writer = conversions.JointWriter(model.robot)
        timing = node.timing
        self._send = partial(node.outbox.send, late=timing.odom_late_ns)
        self._send_scan = partial(node.outbox.send, late=timing.scan_late_ns)
        self._scans = self._publish_on("scan", LaserScan)
        self._odoms = self._publish_on("odom", Odometry)
        self._truths = self._publish_on("ground_truth", Odometry)
        self._joints = self._publish_on("joint_states", JointState)
        self._sensors = [
            (
                sensor,
                frames.prefix + sensor.frame,
                self._publish_on(sensor.name, find_sensor_type(sensor)),
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

    def _publish_on(self, topic: str, kind: Any) -> Publisher:
        made = self._node.create_publisher(
            kind, f"{self._namespace}{topic}", qos.SENSOR_RELIABLE
        )
        self._publishers.append(made)
        return made

    def _subscribe(self) -> None:
        """Listen to `cmd_vel`, `initialpose`, and to `ackermann_cmd` if the robot steers."""
        node = self._node
        space = self._namespace
        quality = qos.EVERY_COMMAND if node.timing.lockstep else qos.COMMAND
        self._stamped = runner.get_flag(node, "enable_stamped_cmd_vel")
        kind = name_of(self._stamped)
        self._commands = node.create_subscription(
            KINDS[kind], f"{space}{CMD_VEL}", self._take_bytes, quality, raw=True
        )
        self._topic = self._commands.topic_name
        self._types = TypeWatch(node, self._topic, kind)
        self._subscriptions = [
            self._commands,
            node.create_subscription(
                PoseWithCovarianceStamped,
                f"{space}{INITIAL_POSE}",
                partial(node.put_robot, self),
                qos.COMMAND,
            ),
        ]
        drive = conversions.find_message_type(
            "ackermann_msgs/msg/AckermannDriveStamped"
        )
        if self._model.robot.steers and drive is not None:  # its package is optional
            topic = f"{space}ackermann_cmd"
            self._subscriptions.append(
                node.create_subscription(drive, topic, self._take_ackermann, quality)
            )

    def close(self) -> None:
        """End its topics."""
        self._types.close()
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._node.outbox.drop(self._publishers)
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)

    def take_waiting(self) -> None:
        """Take the commands that have arrived but are not handled yet."""
        for content in qos.take_waiting(self._commands):
            self._take_bytes(content)

    def _take_bytes(self, content: bytes) -> None:
        stamp_ns = 0
        try:
            if self._stamped:
                stamp_ns = wire.read_stamp(content)
                twist = wire.read_stamped_twist(content)
            else:
                twist = wire.read_twist(content)
        except wire.UNREADABLE as error:
            self._complain(f"a message that can't be read ({error}) is ignored")
            return
        self._obey(stamp_ns, twist, self._model.robot.from_cmd_vel)

    def _take_ackermann(self, message: Any) -> None:
        fields = read_command(message)
        self._obey(get_stamp(message), fields, self._model.robot.from_fields)

    def _obey(
        self,
        stamp_ns: int,
        fields: Sequence[float],
        read: Callable[[Sequence[float]], Array],
    ) -> None:
        if stamp_ns and self._node.is_too_old(stamp_ns):
            self._complain(
                "a command is ignored, because its stamp is older than command_timeout; do both "
                "ends use one clock (use_sim_time)?"
            )
        elif all(map(math.isfinite, fields)):
            self._node.take_command(self, read(fields))
        else:
            self._complain("NaN or inf ignored")

    def _complain(self, what: str) -> None:
        self._node.get_logger().warning(
            f"{self._topic}: {what}", throttle_duration_sec=QUIET_S
        )

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


class MapTopic:
    """Publishes `map`, the occupancy of everything that stands.

    The map also reaches late joiners, and is published again when something has changed. It is not
    computed before anyone subscribes.
    """

    def __init__(self, node: "DeviceNode") -> None:
        self._node = node
        self._cell = runner.get_number(node, "map_resolution")
        self._map = node.create_publisher(OccupancyGrid, "map", qos.LATCHED)
        self._shown: Any = None  # the world that was published, and what stood in it
        runner.call_periodically(node, MAP_S, self.look)

    def look(self) -> None:
        """Publish the map if it has changed."""
        if self._shown is None and not self._map.get_subscription_count():
            return
        world = self._node.device
        simulator = world.simulator
        member = int(simulator.data.member[0])
        still = standing(simulator.sampler, member, simulator.obstacles[0])
        poses = [(shape, tuple(np.asarray(pose))) for shape, pose in still]
        shown = (world, member, poses)
        if shown != self._shown:
            self._shown = shown
            grid = occupancy(world.world, still, self._cell)
            frame = self._node.map_frame
            self._map.publish(conversions.map_to_ros(grid, self._node.now_ns, frame))


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
        self._parts = runner.open_parts("device", self)
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
        self._ports: list[RobotPort] = []
        self.map_topic = MapTopic(self)
        for name in self._names:
            self._ports.append(RobotPort(self, name))
        self._open_transforms()
        runner.serve(self, "~/reset", self._reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        runner.serve(self, "~/repeat", self._repeat)
        runner.serve(self, "~/touched", self._list_touched)
        self.create_service(SelfTest, "~/self_test", self._test)
        runner.diagnose(self, PART, self._look)

    def add_robot(self, namespace: str) -> None:
        """Open the topics of the robot that was added to the device last."""
        self._ports.append(RobotPort(self, namespace))
        self._publish_mounts()

    def reopen_robots(self) -> None:
        """Open the topics of exactly the robots of the start."""
        self.remove_robots(range(len(self._ports)))
        for name in self._names:
            self._ports.append(RobotPort(self, name))
        self._publish_mounts()

    def remove_robots(self, gone: Sequence[int]) -> None:
        """Close the topics of robots that have left the device."""
        for port in [self._ports[k] for k in gone]:
            port.close()
            self._ports.remove(port)
        self._complete.trigger()  # not here: more robots may be about to leave

    def _open_transforms(self) -> None:
        self._transforms: Any = find_transforms(self, "/tf and /tf_static are")
        if self._transforms is None:
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

    def take_command(self, port: RobotPort, command: Array) -> None:
        """Let a robot follow a command (C,)."""
        if port not in self._ports:  # its robot has left since the command arrived
            return
        robot = self._ports.index(port)
        self.device.commands[robot] = command
        port.command_ns = self.now_ns
        if self.timing.lockstep and not self.paused:
            port.has_command = True
            self._advance_if_complete()

    def put_robot(self, port: RobotPort, message: PoseWithCovarianceStamped) -> None:
        """Put a robot at the pose of an `initialpose`, if it can be used."""
        logger = self.get_logger()
        try:
            pose = read_initial_pose(message, self.map_frame)
            check_inside("the pose", self.device.world, pose[0], pose[1])
        except ConfigError as error:
            logger.error(f"{INITIAL_POSE}: {error} The robot stays where it is.")
            return
        at_rest = np.zeros(len(self.model.robot.state))
        self.device.put(self._ports.index(port), pose, at_rest)
        logger.info(
            f"the robot was put at ({pose[0]:.2f}, {pose[1]:.2f}) m, {pose[2]:.2f} rad"
        )

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
            warning = (
                "this machine does not keep up with real time; choose a lower rate, scan_rate or "
                "odom_rate, or fewer robots"
            )
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
            port.take_waiting()
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
    runner.declare_rows(node, "renderer", renderer=default)
    return cast(Renderer, runner.get_choice(node, "renderer", RENDERERS))


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
