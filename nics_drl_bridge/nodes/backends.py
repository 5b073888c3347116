"""Backends over ROS 2: one robot or several in lock-step with a simulator behind topics."""

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

from nics_drl_bridge import interface
from nics_drl_bridge.config import validate
from nics_drl_bridge.env.guard import halts_on_error
from nics_drl_bridge.errors import BackendError, ConfigError, StaleDataError, nearest
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
AGAIN_S = 0.05  # data that do not arrive within this time are requested again [s]
ADVICE = "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and namespace."


class _Mail(NamedTuple):
    stamp_ns: int = -1  # without a message
    arrival_ns: int = 0
    content: bytes = b""


class _Mailbox:
    # The caller is woken once, when all its topics are there: each wake-up costs a good part of a
    # step. The executor's thread gives awaited odometry to `work` while the scan is in transit.
    def __init__(
        self,
        topics: tuple[str, ...],
        work: Callable[[int, int, bytes], None],
        slack_ns: int,
    ) -> None:
        self._slack_ns = slack_ns  # data may be so much older than what is awaited
        self._mail = dict.fromkeys(topics, _Mail())
        self._work = work
        self._lock = threading.Lock()
        self._awaiting = threading.Lock()
        self._awaited_ns = -1
        self._worked_ns = -1
        self._failure: Exception | None = None

    def put(self, topic: str, message: bytes) -> object:
        with self._lock:
            try:
                stamp_ns = _read(topic, wire.stamp_of, message)
                self._mail[topic] = _Mail(stamp_ns, time.monotonic_ns(), message)
                self._work_in()
            except Exception as error:  # noqa: BLE001  (it is raised in the caller's thread)
                self._failure = error
            if self._awaited_ns >= 0 and (
                self._failure or not self._late(self._awaited_ns)
            ):
                if self._awaiting.locked():
                    self._awaiting.release()
                return HANDED_OVER
        return None

    def _work_in(self) -> None:
        if self._worked_ns != (wanted := self._awaited_ns) >= 0 and (
            wanted <= self._mail[ODOM].stamp_ns + self._slack_ns
        ):
            self._worked_ns = self._awaited_ns
            self._work(*self._mail[ODOM])

    def _late(self, stamp_ns: int) -> str | None:
        for topic, mail in self._mail.items():
            if mail.stamp_ns + self._slack_ns < stamp_ns:
                return topic
        return None

    def stamp_ns(self, topic: str) -> int:
        return self._mail[topic].stamp_ns

    def content(self, topic: str) -> bytes:
        return self._mail[topic].content

    def clear(self) -> None:
        with self._lock:
            self._mail = dict.fromkeys(self._mail, _Mail())
            self._worked_ns = -1

    def newest_ns(self) -> int:
        return max(mail.stamp_ns for mail in self._mail.values())

    def wait(self, stamp_ns: int, timeout_s: float) -> dict[str, _Mail]:
        with self._lock:
            self._awaited_ns = stamp_ns
            self._failure = None
            self._awaiting.acquire(blocking=False)
            self._work_in()
            late = self._late(stamp_ns)
        if late is not None:
            self._awaiting.acquire(timeout=timeout_s)  # until `put` releases it
        with self._lock:
            self._awaited_ns = -1
            if self._failure is not None:
                raise self._failure
            if (late := self._late(stamp_ns)) is not None:
                mail = self._mail[late]
                age_s = (time.monotonic_ns() - mail.arrival_ns) * S_PER_NS
                raise StaleDataError(
                    late, age_s if mail.content else math.inf, timeout_s
                )
            return dict(self._mail)


def _put(mail: _Mailbox, topic: str, message: bytes) -> object:
    return mail.put(topic, message)


def _take_odometry(
    middleware: Middleware, stamp_ns: int, arrival_ns: int, message: bytes
) -> None:
    middleware.odometry(stamp_ns, arrival_ns, *_read(ODOM, wire.odometry_of, message))


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    `truth` adds the true pose to `info`; `timeout_s` bounds each wait; the simulator must draw by
    the same `randomisation`; `stamped` says whether `cmd_vel` is a TwistStamped, by default as the
    simulator hears it. The `simulator` of the name `simulation_interfaces` is any that serves
    these; `standard` are options of them, see `StandardOptions`. Raises BackendError if no
    simulator is there, it refuses, is not in lock-step, or another node moved it; ModelError if it
    runs another model or world; StaleDataError if its data do not arrive.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        namespace: str = "",
        simulator: str = "simulator_node",
        timeout_s: float = 30.0,
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
        further = (*self._sensors, TRUTH) if truth else (*self._sensors,)
        self.timeout_s = timeout_s
        self._topics = (ODOM, SCAN, *further)
        # No reference to the backend, which may be garbage.
        take = partial(_take_odometry, self._middleware)
        options = validate(dict(standard or {}), client.StandardOptions, "standard")
        by_standard = (
            simulator == STANDARD.name
        )  # whose steps may be of a rounded length
        self._grain_ns = round(client.TOLERANCE * self._period_ns) if by_standard else 0
        self._slack_ns = max(round(options.slack_s * NS_PER_S), self._grain_ns)
        self._now_ns, self._mail = 0, _Mailbox(self._topics, take, self._slack_ns)
        self._known: BackendFacts = {}
        if randomisation is not None:
            sampler = EpisodeSampler(model, world, randomisation=randomisation)
            self._known["scenes"] = lambda seeds: sampler.draw(seeds)[0]
        self._link = Link(namespace, domain_id, stamped=stamped, patience_s=timeout_s)
        try:
            for topic in self._topics:
                kind = LaserScan if topic == SCAN else Odometry
                if topic in self._sensors:
                    kind = sensor_type(self._sensors[topic])
                put = partial(_put, self._mail, topic)
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
                self._link, model, world, options, self._mail
            )
        return EpisodeServices(self._link, simulator, model, world, randomisation)

    @halts_on_error
    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed in the simulator; see `interface.Backend`."""
        return self.first(self.begin(start), start.pose)

    def begin(self, start: Start) -> int:
        """Begins an episode, the first part of a reset; returns the stamp of its data [ns]."""
        self._link.check_open()
        self._link.check_alone()
        return self._episodes.begin(start, self.timeout_s)

    def first(self, stamp_ns: int, pose: Array) -> RobotView:
        """The second part: waits for the data of a stamp, of a robot that stands at a pose (3,)."""
        self._now_ns = stamp_ns
        self._middleware.reset(stamp_ns, pose)
        view = self.receive()[0]
        self._link.frame = _read(ODOM, wire.frames_of, self._mail.content(ODOM))[1]
        return view

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publishes a command and waits for the data after it; see `interface.Backend`."""
        self.send(command)
        return self.receive()

    @halts_on_error
    def send(self, command: Array) -> None:
        """The first half of a step: checks and publishes a command (C,)."""
        self._link.check_open()
        # Data that arrived before the command would be taken for its answer.
        self._check_stamps()
        twist = self._robot.to_cmd_vel(command)
        self._link.send(twist)
        self._episodes.advance()
        self._link.check_alone()  # while the simulator is at work
        self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
        self._now_ns += self._period_ns

    def _check_stamps(self) -> None:
        for topic in self._topics:
            off_ns = self._mail.stamp_ns(topic) - self._now_ns
            if not -self._slack_ns <= off_ns <= self._grain_ns:
                self._link.check_alone()
                off = f"stamped {off_ns / NS_PER_S:+.3f} s off the step"
                fix = "start the simulator with mode:=lockstep, and move it from here alone."
                raise BackendError(f"topic {topic!r}: {off}; {fix}")

    @halts_on_error
    def receive(self) -> tuple[RobotView, dict[str, Any]]:
        """The second half: waits for the data after the command; returns the view and `info`."""
        mail = self._await(self._now_ns)
        self._check_stamps()
        off_ns = self._mail.stamp_ns(ODOM) - self._now_ns
        now = self._now_ns = self._now_ns + (
            off_ns if abs(off_ns) <= self._grain_ns else 0
        )
        ranges = from_device(
            _read(SCAN, wire.ranges_of, mail[SCAN].content), self._lidar
        )
        self._middleware.scan(now, mail[SCAN].arrival_ns, ranges)
        for name, sensor in self._sensors.items():
            reading = _read(name, partial(sensor_from_ros, sensor), mail[name].content)
            self._middleware.sense(name, now, mail[name].arrival_ns, reading)
        facts = {"stamp_ns": now, **data_facts(self._middleware, time.monotonic_ns())}
        if TRUTH in self._topics:
            facts["true_pose"] = _read(TRUTH, wire.odometry_of, mail[TRUTH].content)[0]
            self._known["true_pose"] = facts["true_pose"]
        return self._middleware.view(now), facts

    def _await(self, stamp_ns: int) -> dict[str, _Mail]:
        deadline = time.monotonic() + self.timeout_s
        while True:
            try:
                left_s = max(0.0, deadline - time.monotonic())
                return self._mail.wait(stamp_ns, min(AGAIN_S, left_s))
            except StaleDataError as error:
                if left_s <= AGAIN_S:
                    raise StaleDataError(
                        error.topic, error.age_s, self.timeout_s
                    ) from None
                self._episodes.repeat()

    def facts(self) -> BackendFacts:
        """Returns the newest true pose, if it was asked for."""
        return self._known

    def halt(self) -> None:
        """Publishes a zero command; the episode is over."""
        self._link.halt()

    def close(self) -> None:
        """Publishes a zero command and ends the node."""
        self._link.close()


def _read(topic: str, read: Callable[[bytes], T], message: bytes) -> T:
    try:
        return read(message)
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
        simulator: str = "/simulator_node",
        **options: Any,
    ) -> None:
        if len(set(namespaces)) < max(2, len(namespaces)):
            given = f"namespaces {list(namespaces)!r}"
            raise ConfigError(
                f"backend_options: {given} must be of at least two different robots."
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
        """Begins one episode for all robots, at poses (M, 3); see `DdsBackend.reset`."""
        stamp_ns = self._robots[0].begin(start)
        both = zip(self._robots, start.pose, strict=True)
        return interface.stacked([robot.first(stamp_ns, pose) for robot, pose in both])

    @halts_on_error
    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publishes all commands (M, C) and waits for all data after them."""
        for robot, one in zip(self._robots, command, strict=True):
            robot.send(one)
        views, facts = zip(*(robot.receive() for robot in self._robots), strict=True)
        return interface.stacked(views), together(facts)

    def facts(self) -> BackendFacts:
        """Returns what is known of all robots, stacked."""
        return cast("BackendFacts", together([robot.facts() for robot in self._robots]))

    def halt(self) -> None:
        """Publishes a zero command for each robot, even if one of them raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.halt)

    def close(self) -> None:
        """Publishes a zero command for each robot and ends the nodes, even if one raises."""
        with ExitStack() as each:
            for robot in self._robots:
                each.callback(robot.close)


def together(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Merges the facts of M robots: equal values stay as they are, others become (M, ...)."""
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
    """Returns the backend for the options; ConfigError if they do not go together, BackendError."""
    if not estimator:
        raise ConfigError("backend 'dds' always estimates; leave out `estimator`.")
    if randomisation is not None:
        if mode != "lockstep" or robots > 1:
            needed = "one robot in mode 'lockstep' alone can be randomised"
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
            f"backend_options: there is no mode {mode!r}; {nearest(mode, MODES)}"
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
