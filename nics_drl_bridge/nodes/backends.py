"""Backends over ROS 2: one robot or several in lock-step with a simulator behind topics.

A step of `DdsBackend` is `send` and `receive`. `send` publishes the command, and the simulator
simulates one control period. `receive` waits until the scan and the odometry of the end of that
period are in the inbox, hands them to the middleware, and returns its view. Two threads work: the
caller's, and the executor's, which takes messages from ROS 2 and puts them into the inbox.
"""

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan

from nics_drl_bridge import defaults, interface
from nics_drl_bridge.config import validate
from nics_drl_bridge.env.guard import halts_on_error
from nics_drl_bridge.errors import BackendError, ConfigError, StaleDataError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import (
    NS_PER_S,
    S_PER_NS,
    Array,
    BackendFacts,
    RobotView,
    Start,
)
from nics_drl_bridge.lidar.spec import from_device
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.conversions import sensor_from_ros, sensor_type
from nics_drl_bridge.nodes.device_parameters import default_namespaces
from nics_drl_bridge.nodes.executor import HANDED_OVER
from nics_drl_bridge.nodes.link import EpisodeServices, Link
from nics_drl_bridge.nodes.parameters import STANDARD
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.nodes.robot_topics import data_facts
from nics_drl_bridge.nodes.simulation_interfaces import client
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation
from nics_drl_bridge.sim.simulator import EpisodeSampler
from nics_drl_bridge.sim.world_set import AnyWorld

T = TypeVar("T")
SCAN = "scan"
ODOM = "odom"
TRUTH = "ground_truth"
# The simulator is asked to repeat data that do not arrive within this time [s].
REPEAT_S = 0.05
ADVICE = "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and namespace."


class _Message(NamedTuple):
    stamp_ns: int = -1  # before any message
    arrival_ns: int = 0
    content: bytes = b""


class _Inbox:
    """The latest message of each topic, and the wait for those of one stamp.

    The executor's thread puts messages in; the caller's thread waits. The caller is woken once,
    when the messages of all topics are there, because each wake-up costs a good part of a step.
    The executor's thread does not idle until then: it updates the estimator with the awaited
    odometry while the scan is still in transit.
    """

    def __init__(
        self,
        topics: tuple[str, ...],
        update_estimator: Callable[[int, int, bytes], None],
        lag_ns: int,
    ) -> None:
        # Messages may be older than the awaited stamp by this much.
        self._lag_ns = lag_ns
        self._messages = dict.fromkeys(topics, _Message())
        self._update_estimator = update_estimator
        self._lock = threading.Lock()
        # Locked while the caller waits, released to wake it: cheaper than an Event.
        self._caller_waits = threading.Lock()
        self._awaited_ns = -1  # while nothing is awaited
        self._estimated_ns = -1  # the awaited stamp of the last update of the estimator
        self._failure: Exception | None = None

    def put(self, topic: str, content: bytes) -> object:
        """Store a message; returns HANDED_OVER if that woke the caller."""
        with self._lock:
            try:
                stamp_ns = _read(topic, wire.stamp_of, content)
                self._messages[topic] = _Message(stamp_ns, time.monotonic_ns(), content)
                self._estimate_if_due()
            except Exception as error:  # noqa: BLE001  (it is raised in the caller's thread)
                self._failure = error
            is_awaited = self._awaited_ns >= 0
            if is_awaited and (self._failure or not self._find_late(self._awaited_ns)):
                if self._caller_waits.locked():
                    self._caller_waits.release()
                return HANDED_OVER
        return None

    def _estimate_if_due(self) -> None:
        """Update the estimator, once, with the odometry that is awaited, if it is there."""
        awaited_ns = self._awaited_ns
        if awaited_ns < 0 or self._estimated_ns == awaited_ns:
            return
        if awaited_ns <= self._messages[ODOM].stamp_ns + self._lag_ns:
            self._estimated_ns = awaited_ns
            self._update_estimator(*self._messages[ODOM])

    def _find_late(self, stamp_ns: int) -> str | None:
        """Return the first topic whose message of a stamp is not there; None if all are."""
        for topic, message in self._messages.items():
            if message.stamp_ns + self._lag_ns < stamp_ns:
                return topic
        return None

    def stamp_ns(self, topic: str) -> int:
        """Stamp of the latest message of a topic [ns]."""
        return self._messages[topic].stamp_ns

    def content(self, topic: str) -> bytes:
        """The latest message of a topic, serialized."""
        return self._messages[topic].content

    def clear(self) -> None:
        """Drop all messages."""
        with self._lock:
            self._messages = dict.fromkeys(self._messages, _Message())
            self._estimated_ns = -1

    def newest_ns(self) -> int:
        """The newest stamp of any topic [ns]."""
        return max(message.stamp_ns for message in self._messages.values())

    def wait(self, stamp_ns: int, timeout_s: float) -> dict[str, _Message]:
        """Wait for the messages of a stamp. Raises StaleDataError if a topic is late."""
        with self._lock:
            self._awaited_ns = stamp_ns
            self._failure = None
            self._caller_waits.acquire(blocking=False)
            self._estimate_if_due()
            late_topic = self._find_late(stamp_ns)
        if late_topic is not None:
            self._caller_waits.acquire(timeout=timeout_s)  # until `put` releases it
        with self._lock:
            self._awaited_ns = -1
            if self._failure is not None:
                raise self._failure
            late_topic = self._find_late(stamp_ns)
            if late_topic is None:
                return dict(self._messages)
            latest = self._messages[late_topic]
            age_s = math.inf
            if latest.content:
                age_s = (time.monotonic_ns() - latest.arrival_ns) * S_PER_NS
            raise StaleDataError(late_topic, age_s, timeout_s)


def _put(inbox: _Inbox, topic: str, content: bytes) -> object:
    return inbox.put(topic, content)


def _update_estimator(
    middleware: Middleware, stamp_ns: int, arrival_ns: int, content: bytes
) -> None:
    middleware.odometry(stamp_ns, arrival_ns, *_read(ODOM, wire.odometry_of, content))


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    `truth` adds the true pose to `info`. `timeout_s` bounds each wait. The simulator must draw from
    the same `randomisation`. `stamped` selects TwistStamped for `cmd_vel`; by default the type to
    which the simulator subscribes is used. With the `simulator` named `simulation_interfaces`, any
    simulator that serves these interfaces will do; `standard` holds its `StandardOptions`.

    Raises BackendError if there is no simulator, it refuses, it is not in lock-step or another node
    moved it; ModelError if it runs another model or world; StaleDataError if data do not arrive.
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
        standard: Mapping[str, Any] | None = None,
    ) -> None:
        self._robot = model.robot
        self._lidar = model.lidar
        self._robot.require_cmd_vel()
        self._sensors = {sensor.name: sensor for sensor in model.sensors}
        self._middleware = Middleware(model)
        self._period_ns = round(model.control_period * NS_PER_S)
        self.timeout_s = timeout_s
        self._topics = (ODOM, SCAN, *self._sensors)
        if truth:
            self._topics = (*self._topics, TRUTH)
        options = validate(dict(standard or {}), client.StandardOptions, "standard")
        # A simulator of the standard may round the length of its steps.
        self._rounding_ns = 0
        if simulator == STANDARD.name:
            self._rounding_ns = round(client.TOLERANCE * self._period_ns)
        self._lag_ns = max(round(options.slack_s * NS_PER_S), self._rounding_ns)
        # Simulated time at the end of the last step.
        self._now_ns = 0
        # Callbacks hold no reference to the backend, so that it can be garbage-collected.
        update_estimator = partial(_update_estimator, self._middleware)
        self._inbox = _Inbox(self._topics, update_estimator, self._lag_ns)
        self._facts: BackendFacts = {}
        if randomisation is not None:
            sampler = EpisodeSampler(model, world, randomisation=randomisation)
            self._facts["scenes"] = lambda seeds: sampler.draw(seeds)[0]
        self._link = Link(namespace, domain_id, stamped=stamped, patience_s=timeout_s)
        try:
            for topic in self._topics:
                kind = LaserScan if topic == SCAN else Odometry
                if topic in self._sensors:
                    kind = sensor_type(self._sensors[topic])
                put = partial(_put, self._inbox, topic)
                self._link.node.create_subscription(
                    kind, topic, put, qos.SENSOR, raw=True
                )
            self._episodes = self._services(
                model, world, simulator, options, randomisation
            )
            self._link.begin()
            self._link.wait_for_peers(
                self._topics, self._episodes.clients, timeout_s, ADVICE
            )
            self._episodes.open(timeout_s)
        except BaseException:
            self.close()
            raise

    def _services(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        simulator: str,
        options: client.StandardOptions,
        randomisation: Randomisation | None,
    ) -> EpisodeServices | client.StandardEpisodes:
        if simulator == STANDARD.name:
            return client.StandardEpisodes(
                self._link, model, world, options, self._inbox
            )
        return EpisodeServices(self._link, simulator, model, world, randomisation)

    @halts_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin the episode of a seed in the simulator; see `interface.Backend`."""
        return self.first(self.begin(start), start.pose)

    def begin(self, start: Start) -> int:
        """Begin an episode, the first half of a reset; return the stamp of its first data [ns]."""
        self._link.check_open()
        self._link.check_alone()
        return self._episodes.begin(start, self.timeout_s)

    def first(self, stamp_ns: int, pose: Array) -> RobotView:
        """Wait for the first data of an episode, the second half of a reset.

        stamp_ns: what `begin` returned; pose: (3,), where the robot stands.
        """
        self._now_ns = stamp_ns
        self._middleware.reset(stamp_ns, pose)
        view = self.receive()[0]
        self._link.frame = _read(ODOM, wire.frames_of, self._inbox.content(ODOM))[1]
        return view

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish a command and wait for the data at the end of its control period."""
        self.send(command)
        return self.receive()

    @halts_on_error
    def send(self, command: Array) -> None:
        """Check and publish a command (C,), the first half of a step."""
        self._link.check_open()
        # If the simulator ran ahead, its data would be taken for the answer to this command.
        self._check_stamps()
        twist = self._robot.to_cmd_vel(command)
        self._link.send(twist)
        self._episodes.advance()
        # Checked while the simulator is busy: this is free.
        self._link.check_alone()
        self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
        self._now_ns += self._period_ns

    def _check_stamps(self) -> None:
        """Raise BackendError unless the latest data are those of the last step."""
        for topic in self._topics:
            ahead_ns = self._inbox.stamp_ns(topic) - self._now_ns
            if not -self._lag_ns <= ahead_ns <= self._rounding_ns:
                self._link.check_alone()
                off = f"stamped {ahead_ns / NS_PER_S:+.3f} s off the step"
                fix = "start the simulator with mode:=lockstep, and move it from here alone."
                raise BackendError(f"topic {topic!r}: {off}; {fix}")

    @halts_on_error
    def receive(self) -> tuple[RobotView, dict[str, Any]]:
        """Wait for the data at the end of the period, the second half of a step.

        Returns the view and `info`. The estimator has the odometry already, see `_Inbox`.
        """
        messages = self._wait_for_data(self._now_ns)
        self._check_stamps()
        rounded_by_ns = self._inbox.stamp_ns(ODOM) - self._now_ns
        if abs(rounded_by_ns) <= self._rounding_ns:
            self._now_ns += rounded_by_ns
        scan = messages[SCAN]
        ranges = from_device(_read(SCAN, wire.ranges_of, scan.content), self._lidar)
        self._middleware.scan(self._now_ns, scan.arrival_ns, ranges)
        for name, sensor in self._sensors.items():
            message = messages[name]
            read = partial(sensor_from_ros, sensor)
            reading = _read(name, read, message.content)
            self._middleware.sense(name, self._now_ns, message.arrival_ns, reading)
        info: dict[str, Any] = {"stamp_ns": self._now_ns}
        info |= data_facts(self._middleware, time.monotonic_ns())
        if TRUTH in self._topics:
            true_pose = _read(TRUTH, wire.odometry_of, messages[TRUTH].content)[0]
            info["true_pose"] = true_pose
            self._facts["true_pose"] = true_pose
        return self._middleware.view(self._now_ns), info

    def _wait_for_data(self, stamp_ns: int) -> dict[str, _Message]:
        """Wait for the data of a stamp; have the simulator repeat what was lost on the way."""
        deadline = time.monotonic() + self.timeout_s
        while True:
            remaining_s = max(0.0, deadline - time.monotonic())
            try:
                return self._inbox.wait(stamp_ns, min(REPEAT_S, remaining_s))
            except StaleDataError as error:
                if remaining_s <= REPEAT_S:
                    raise StaleDataError(
                        error.topic, error.age_s, self.timeout_s
                    ) from None
                self._episodes.repeat()

    def facts(self) -> BackendFacts:
        """Return the newest true pose, if it was requested."""
        return self._facts

    def halt(self) -> None:
        """Publish a zero command; the episode is over."""
        self._link.halt()

    def close(self) -> None:
        """Publish a zero command and end the node."""
        self._link.close()


def _read(topic: str, read: Callable[[bytes], T], content: bytes) -> T:
    """Deserialize a message. Raises BackendError if it is damaged."""
    try:
        return read(content)
    except wire.UNREADABLE as error:
        reason = f"a message can't be read ({error}); look at who publishes it."
        raise BackendError(f"topic {topic!r}: {reason}") from None


class FleetBackend:
    """M robots (M, ...) in lock-step with one simulator node; BackendError if one is missing."""

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        namespaces: Sequence[str],
        simulator: str = f"/{defaults.SIMULATOR_NODE}",
        **options: Any,
    ) -> None:
        if len(set(namespaces)) < max(2, len(namespaces)):
            given = f"namespaces {list(namespaces)!r}"
            raise ConfigError(
                f"backend_options: {given} must name at least two different robots."
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

    @halts_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin one episode for all robots, at poses (M, 3); see `DdsBackend.reset`."""
        stamp_ns = self._robots[0].begin(start)
        both = zip(self._robots, start.pose, strict=True)
        return interface.stack_views(
            [robot.first(stamp_ns, pose) for robot, pose in both]
        )

    @halts_on_error
    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish all commands (M, C) and wait for all data after them."""
        for robot, robot_command in zip(self._robots, command, strict=True):
            robot.send(robot_command)
        views, facts = zip(*(robot.receive() for robot in self._robots), strict=True)
        return interface.stack_views(views), together(facts)

    def facts(self) -> BackendFacts:
        """Return what is known of all robots, stacked."""
        return cast("BackendFacts", together([robot.facts() for robot in self._robots]))

    def halt(self) -> None:
        """Publish a zero command for each robot, even if one of them raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.halt)

    def close(self) -> None:
        """Publish a zero command for each robot and end the nodes, even if one raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.close)


def together(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge the facts of M robots: equal values stay as they are, others become (M, ...)."""
    values = {name: [each[name] for each in facts] for name in facts[0]}
    return {
        name: every[0]
        if all(np.array_equal(every[0], one) for one in every)
        else np.stack(every)
        for name, every in values.items()
    }


MODES = {"lockstep": DdsBackend, "realtime": RealtimeBackend}


def dds_backend(
    model: SimulatorModel,
    world: AnyWorld,
    mode: str = "lockstep",
    robots: int = 1,
    estimator: bool = True,
    randomisation: str | Randomisation | None = None,
    **options: Any,
) -> interface.Backend:
    """Return the backend for the options. Raises ConfigError if they conflict; BackendError."""
    if not estimator:
        raise ConfigError(
            "backend 'dds' always estimates the state; leave out `estimator`."
        )
    if randomisation is not None:
        if mode != "lockstep" or robots > 1:
            needed = "only one robot in mode 'lockstep' can be randomised"
            raise ConfigError(
                f"backend 'dds': {needed}, not {robots} in mode {mode!r}."
            )
        if not isinstance(randomisation, Randomisation):
            randomisation = load_randomisation(randomisation)
        options["randomisation"] = randomisation
    if options.get("simulator") == STANDARD.name and (
        randomisation is not None or mode != "lockstep" or robots > 1
    ):
        needed = "one robot in mode 'lockstep', without randomisation"
        raise ConfigError(
            f"simulator {STANDARD.name!r}: drives {needed}; leave out the rest."
        )
    if mode not in MODES:
        raise ConfigError(
            f"backend_options: there is no mode {mode!r}; {suggest(mode, MODES)}"
        )
    if robots > 1:
        names = options.pop("namespaces", default_namespaces(robots))
        if mode != "lockstep" or len(names) != robots:
            needed = f"in mode 'lockstep' alone, with {robots} namespaces"
            given = (
                f"a team of {robots} robots is driven {needed}, not in {mode!r} with"
            )
            raise ConfigError(f"backend_options: {given} {list(names)!r}.")
        return FleetBackend(model, world, names, **options)
    made: interface.Backend = MODES[mode](model, world, **options)
    return made
