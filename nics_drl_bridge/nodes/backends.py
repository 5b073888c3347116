"""Backends over ROS 2 in lock-step: a simulator moves by one control period for each step.

A step of `DdsBackend` is `send` and `receive`. With t, the simulated time at the end of the last
step:

1. `send` checks that the newest data are those of t, publishes the command, and adds one control
   period to t.
2. The simulator takes the command, simulates one control period, and publishes odometry and scan
   with the stamp t.
3. `receive` runs the callbacks of the link, which put each message into the `Inbox`, until all
   messages of t are there. The odometry of t updates the estimator while the scan is in transit.
4. `receive` hands the scan to the middleware, and returns the middleware's view of the robot at t.

A simulator of this package moves once each of its robots has a command, and sends a message again
that was lost on the way.
`reset` begins an episode by the simulator's services, and ends like a step.
"""

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, cast

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan

from nics_drl_bridge import defaults, interface
from nics_drl_bridge.arguments import list_keywords, refuse_unknown
from nics_drl_bridge.env.guard import delay_interrupts, stop_on_error
from nics_drl_bridge.errors import BackendError, ConfigError, StaleDataError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array, BackendFacts, RobotView, Start
from nics_drl_bridge.lidar.spec import from_device
from nics_drl_bridge.middleware.measurement import ODOM, SCAN
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.conversions import find_sensor_type, sensor_from_ros
from nics_drl_bridge.nodes.link import (
    EpisodeServices,
    Inbox,
    Link,
    read_message,
)
from nics_drl_bridge.nodes.parameters import (
    LOCKSTEP,
    REALTIME,
    name_fleet,
)
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world_set import AnyWorld

TRUTH = "ground_truth"
# The simulator is asked to repeat data that do not arrive within this time [s].
REPEAT_S = 0.05
# How to start the simulator, as the end of an error.
START_SIMULATOR = (
    "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and "
    "namespace."
)
# What all robots of a fleet share; any other fact is of one robot.
SHARED_FACTS = ("stamp_ns",)


def dds_backend(
    model: SimulatorModel,
    world: AnyWorld,
    mode: str = LOCKSTEP,
    robots: int = 1,
    estimator: bool = True,
    randomisation: str | Randomisation | None = None,
    **options: Any,
) -> interface.Backend:
    """Return the backend for the options.

    Args:
        model: the robot's model.
        world: the world, which a simulator has to run, too.
        mode: `lockstep` or `realtime`.
        robots: number of robots; several need `namespaces`, or have the simulator's default ones.
        estimator: True, because the state is always estimated.
        randomisation: what the simulator draws from, or its name.
        options: of `DdsBackend`, `FleetBackend` or `RealtimeBackend`.

    Raises:
        ConfigError: if options conflict or are unknown.
        BackendError: if the robot or the simulator can't be reached.
    """
    if not estimator:
        raise ConfigError(
            "backend 'dds' always estimates the state; leave out `estimator`."
        )
    is_single_lockstep = mode == LOCKSTEP and robots == 1
    if randomisation is not None and not is_single_lockstep:
        needed = "only one robot in mode 'lockstep' can be randomised"
        raise ConfigError(f"backend 'dds': {needed}, not {robots} in mode {mode!r}.")
    if mode not in (LOCKSTEP, REALTIME):
        fix = suggest(mode, (LOCKSTEP, REALTIME))
        raise ConfigError(f"backend_options: there is no mode {mode!r}; {fix}")
    option_names = list_keywords(DdsBackend)
    if robots > 1:
        namespaces = options.pop("namespaces", name_fleet(robots))
        if mode != LOCKSTEP or len(namespaces) != robots:
            needed = f"in mode 'lockstep' alone, with {robots} namespaces"
            raise ConfigError(
                f"backend_options: a team of {robots} robots is driven {needed}, not in "
                f"{mode!r} with {list(namespaces)!r}."
            )
        refuse_unknown("backend 'dds'", options, option_names - {"namespace"})
        return FleetBackend(model, world, namespaces, **options)
    if mode == REALTIME:
        return RealtimeBackend(model, world, **options)
    refuse_unknown("backend 'dds'", options, option_names)
    if isinstance(randomisation, str):
        randomisation = load_randomisation(randomisation)
    return DdsBackend(model, world, randomisation=randomisation, **options)


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    Args:
        model: the robot's model, which the simulator has to run, too.
        world: the world, which the simulator has to run, too.
        namespace: of the robot's topics.
        simulator: name of the simulator's node.
        timeout_s: longest wait for a peer, an answer or data [s].
        truth: True to add the true pose to `info`.
        domain_id: of ROS 2; by default that of the environment.
        randomisation: from which the simulator draws, too.
        stamped: True for a TwistStamped on `cmd_vel`; by default what the simulator subscribes to.

    Raises:
        BackendError: if there is no simulator, if it refuses, if it is not in lock-step, or if
            another node moved it.
        ConfigError: if an option is wrong.
        ModelError: if the simulator runs another model or world.
        StaleDataError: if data do not arrive.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        namespace: str = "",
        simulator: str = defaults.SIMULATOR_NODE,
        timeout_s: float = defaults.ANSWER_S,
        truth: bool = False,
        domain_id: int | None = None,
        randomisation: Randomisation | None = None,
        stamped: bool | None = None,
    ) -> None:
        self.timeout_s = timeout_s
        self._robot = model.robot
        self._robot.require_cmd_vel()
        self._lidar = model.lidar
        self._sensors = {sensor.name: sensor for sensor in model.sensors}
        self._has_truth = truth
        self._topics = (ODOM, SCAN, *self._sensors, *((TRUTH,) if truth else ()))
        self._middleware = Middleware(model)
        self._facts: BackendFacts = {}
        if randomisation is not None:
            sampler = EpisodeSampler(model, world, randomisation=randomisation)
            self._facts["scenes"] = lambda seeds: sampler.draw(seeds)[0]

        self._period_ns = round(model.control_period * NS_PER_S)
        self._now_ns = 0  # simulated time at the end of the last step
        self._can_send = False  # True while the data of the last step are known

        self._inbox = Inbox(self._topics)
        self._link = Link(namespace, domain_id, stamped=stamped, patience_s=timeout_s)
        try:
            self._subscribe()
            self._episodes = EpisodeServices(
                self._link, simulator, model, world, randomisation
            )
            self._link.wait_for_peers(
                self._topics, self._episodes.clients, timeout_s, START_SIMULATOR
            )
        except BaseException:
            self.close()
            raise

    def _subscribe(self) -> None:
        kinds = dict.fromkeys(self._topics, Odometry)
        kinds[SCAN] = LaserScan
        kinds |= {
            name: find_sensor_type(sensor) for name, sensor in self._sensors.items()
        }
        self._subscriptions = {}
        for topic, kind in kinds.items():
            # Callbacks hold no reference to the backend, so that it can be garbage-collected.
            put = partial(self._inbox.put, topic)
            self._subscriptions[topic] = self._link.node.create_subscription(
                kind, topic, put, qos.SENSOR, raw=True
            )

    @stop_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin the episode of a seed in the simulator; see `interface.Backend`."""
        stamp_ns = self.begin(start)
        return self.receive_first(stamp_ns, start.pose)

    def begin(self, start: Start) -> int:
        """Begin an episode, the first half of a reset; return the stamp of its first data [ns]."""
        self.prepare()
        return self._episodes.begin(start, self.timeout_s)

    def prepare(self) -> None:
        """Check that an episode can begin, and forget what failed in the last one."""
        self._link.check_open()
        self._link.check_alone()
        self._can_send = False

    def receive_first(self, stamp_ns: int, pose: Array) -> RobotView:
        """Wait for the first data of an episode, the second half of a reset.

        Args:
            stamp_ns: what `begin` returned.
            pose: (3,) of the robot at the start.
        """
        self._now_ns = stamp_ns
        self._middleware.reset(stamp_ns, pose)
        view, _ = self.receive()
        odometry = self._inbox.messages[ODOM]
        _, self._link.frame = read_message(ODOM, wire.read_frames, odometry.content)
        return view

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish a command and wait for the data at the end of its control period."""
        self.send(command)
        return self.receive()

    @stop_on_error
    def send(self, command: Array) -> None:
        """Check and publish a command (C,), the first half of a step."""
        self._link.check_open()
        if not self._can_send:
            raise BackendError(
                "the last step did not end: its data did not arrive, or no episode has begun; "
                "call reset()."
            )
        # If the simulator ran ahead, its data would be taken for the answer to this command.
        self._take_waiting()
        self._check_stamps()
        twist = self._robot.to_cmd_vel(command)
        self._can_send = False
        self._link.send(twist)
        # Checked while the simulator is busy: this is free.
        self._link.check_alone()
        self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
        self._now_ns += self._period_ns

    @stop_on_error
    def receive(self) -> tuple[RobotView, dict[str, Any]]:
        """Wait for the data at the end of the period, the second half of a step.

        Returns the view and `info`.
        """
        self._wait_for_data()
        messages = self._inbox.messages
        self._check_stamps()
        scan = messages[SCAN]
        device_ranges = read_message(SCAN, wire.read_ranges, scan.content)
        ranges = from_device(device_ranges, self._lidar)
        self._middleware.scan(self._now_ns, scan.arrival_ns, ranges)
        self._take_readings()
        info: dict[str, Any] = {"stamp_ns": self._now_ns}
        info |= self._middleware.list_facts(time.monotonic_ns())
        if self._has_truth:
            true_pose, _ = read_message(
                TRUTH, wire.read_odometry, messages[TRUTH].content
            )
            info["true_pose"] = true_pose
            self._facts["true_pose"] = true_pose
        view = self._middleware.view(self._now_ns)
        self._can_send = True
        return view, info

    def _take_readings(self) -> None:
        for name, sensor in self._sensors.items():
            message = self._inbox.messages[name]
            read = partial(sensor_from_ros, sensor)
            reading = read_message(name, read, message.content)
            self._middleware.sense(name, self._now_ns, message.arrival_ns, reading)

    def _wait_for_data(self) -> None:
        """Wait for the data of the step; have the simulator repeat what was lost on the way.

        The odometry updates the estimator as soon as it is there.
        """
        began_s = time.monotonic()
        repeat_s = began_s + REPEAT_S
        is_estimated = False
        while True:
            if not is_estimated and self._inbox.has(ODOM, self._now_ns):
                odometry = self._inbox.messages[ODOM]
                measured = read_message(ODOM, wire.read_odometry, odometry.content)
                arrival_ns = odometry.arrival_ns
                self._middleware.odometry(odometry.stamp_ns, arrival_ns, *measured)
                is_estimated = True
            late = [t for t in self._topics if not self._inbox.has(t, self._now_ns)]
            if not late:
                return
            now_s = time.monotonic()
            if now_s > began_s + self.timeout_s:
                age_s = self._inbox.messages[late[0]].age_s
                raise StaleDataError(late[0], age_s, self.timeout_s)
            if now_s > repeat_s:
                self._episodes.repeat()
                repeat_s = now_s + REPEAT_S
            self._link.spin()
            self._take_waiting()

    def _take_waiting(self) -> None:
        """Put all messages that have arrived into the inbox; quicker than a callback for each."""
        with (
            delay_interrupts()
        ):  # Ctrl-C amid a call of the library would leave it undefined
            for topic, subscription in self._subscriptions.items():
                for content in qos.take_waiting(subscription):
                    self._inbox.put(topic, content)

    def _check_stamps(self) -> None:
        """Raise BackendError unless the newest data are those of the last step."""
        for topic in self._topics:
            ahead_ns = self._inbox.messages[topic].stamp_ns - self._now_ns
            if not ahead_ns:
                continue
            self._link.check_alone()
            raise BackendError(
                f"topic {topic!r}: stamped {ahead_ns / NS_PER_S:+.3f} s off the step; start "
                "the simulator with mode:=lockstep, and move it from here alone."
            )

    def facts(self) -> BackendFacts:
        """Return the newest true pose, if `truth`, and with a randomisation how to draw scenes."""
        return self._facts

    def halt(self) -> None:
        """Publish a zero command; the episode is over."""
        self._link.halt()

    def close(self) -> None:
        """Publish a zero command and end the node."""
        self._link.close()


class FleetBackend:
    """M robots in lock-step with one simulator node, each in its namespace.

    Commands, poses and views have a leading (M,). `options` are those of `DdsBackend`. Raises
    ConfigError for wrong namespaces, BackendError if a robot is missing.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        namespaces: Sequence[str],
        simulator: str = f"/{defaults.SIMULATOR_NODE}",
        **options: Any,
    ) -> None:
        if len(namespaces) < 2 or len(set(namespaces)) < len(namespaces):
            raise ConfigError(
                f"backend_options: namespaces {list(namespaces)!r} must name two robots or more, "
                "each of them once."
            )
        self._robots: list[DdsBackend] = []
        try:
            for namespace in namespaces:
                self._robots.append(
                    DdsBackend(model, world, namespace, simulator, **options)
                )
        except BaseException:
            self.close()
            raise

    @stop_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin one episode for all robots, at poses (M, 3); see `DdsBackend.reset`."""
        for robot in self._robots[1:]:
            robot.prepare()
        stamp_ns = self._robots[0].begin(start)
        views = [
            robot.receive_first(stamp_ns, pose)
            for robot, pose in zip(self._robots, start.pose, strict=True)
        ]
        return interface.stack_views(views)

    @stop_on_error
    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish all commands (M, C) and wait for all data after them."""
        for robot, robot_command in zip(self._robots, command, strict=True):
            robot.send(robot_command)
        views, infos = zip(*(robot.receive() for robot in self._robots), strict=True)
        return interface.stack_views(views), stack_facts(infos)

    def facts(self) -> BackendFacts:
        """Return the facts of all robots, stacked."""
        facts = stack_facts([robot.facts() for robot in self._robots])
        return cast("BackendFacts", facts)

    def halt(self) -> None:
        """Publish a zero command for each robot, even if one of them raises."""
        with ExitStack() as calls:
            for robot in self._robots:
                calls.callback(robot.halt)

    def close(self) -> None:
        """Publish a zero command for each robot and end the nodes, even if one raises."""
        with ExitStack() as calls:
            for robot in self._robots:
                calls.callback(robot.close)


def stack_facts(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge the facts of M robots into arrays (M, ...); `SHARED_FACTS` stay as they are."""
    stacked = {}
    for name, value in facts[0].items():
        if name in SHARED_FACTS:
            stacked[name] = value
        else:
            stacked[name] = np.stack([robot[name] for robot in facts])
    return stacked
