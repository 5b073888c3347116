"""RealtimeBackend: a vehicle, or a simulator on the wall clock, as a synchronous backend."""

import math
import time
from collections.abc import Callable
from typing import Any, Literal

from pydantic import Field, PositiveFloat

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.config import Schema, validate
from nics_drl_bridge.env.guard import halts_on_error
from nics_drl_bridge.errors import BackendError, StaleDataError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array, BackendFacts, RobotView, Start
from nics_drl_bridge.middleware.measurement import CMD_VEL, SCAN
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes.link import EpisodeServices, Link
from nics_drl_bridge.nodes.robot_topics import RobotTopics, data_facts, declare_sensors
from nics_drl_bridge.nodes.runner import holds
from nics_drl_bridge.sim.world_set import AnyWorld

POLL_S = 0.01
SAY_EVERY_S = 2.0
# a peer without services this long after its topics appeared is a vehicle [s]
SERVICES_S = 0.5
COMMAND_S = 0.5  # minimum time [s] and number of periods for which a command lasts
PERIODS = 2  # after them a zero command follows
STILL = (0.02, 0.05)  # a robot below these speeds is at rest [m/s, rad/s]
ADVICE = (
    "start the robot, or `simulator_node` with mode:=realtime, in the same ROS_DOMAIN_ID and "
    "namespace."
)


class RealtimeOptions(Schema):
    """Options of `RealtimeBackend`."""

    namespace: str = ""  # of the robot
    simulator: str = defaults.SIMULATOR_NODE  # name of its node in that namespace
    domain_id: int | None = Field(None, ge=0, le=232)  # the environment's by default
    timeout_s: PositiveFloat = defaults.ANSWER_S  # longest wait for a peer or an answer
    vehicle: bool | None = None  # a vehicle has no services; None: detected
    # duration of a step; the model's control period by default
    period_s: PositiveFloat | None = None
    stale_after_s: PositiveFloat = 0.5  # age above which data are too old for a view
    # On a vehicle, wait until it stands at the requested pose, or start at the present one.
    start: Literal["wait", "present"] = defaults.VEHICLE_START
    # Lay `map` so that the robot's present place is the start; not possible with a pose sensor.
    lays_map: bool = False
    # tolerance of the start pose [m, rad]
    tolerance: tuple[PositiveFloat, PositiveFloat] = (0.1, 0.1)
    start_timeout_s: PositiveFloat = 300.0  # longest wait for the start
    # receives what is missing for the start; the node's logger by default
    say: Callable[[str], None] | None = None
    # With `cmd_vel_raw`, commands pass `command_gate`: each is a TwistStamped with the stamp of the
    # scan that it answers.
    command_topic: str = Field("cmd_vel", min_length=1)
    # use TwistStamped for `cmd_vel`; None: the type to which the robot subscribes
    stamped: bool | None = None
    pose_type: str = (
        defaults.POSE_TYPE
    )  # message type of `pose`, a pose sensor in `map`
    # Topic of the gyro for the yaw rate; `auto`: the usual topics, if the model was made with one
    imu: str = Field(defaults.IMU_TOPIC, min_length=1)

    @property
    def gated(self) -> bool:
        """True if commands pass a `command_gate`."""
        return self.command_topic.rsplit("/", 1)[-1] == "cmd_vel_raw"


class RealtimeBackend:
    """One robot behind its topics, stepped at a fixed period of the steady clock.

    Deadlines that a late caller misses are counted, not made up for. Raises ConfigError if an
    option can't be used; BackendError if there is no peer, or it refuses or does not come to rest;
    ModelError for another model or world; StaleDataError for data older than `stale_after_s`.
    """

    def __init__(self, model: SimulatorModel, world: AnyWorld, **options: Any) -> None:
        chosen = validate(options, RealtimeOptions, "backend_options")
        self._options = chosen
        self._robot = model.robot
        self._period_ns = round((chosen.period_s or model.control_period) * NS_PER_S)
        self._deadline_ns = self._misses = 0
        self._scan_ns = 0  # stamp of the scan in the newest view [ns]
        rehearse(model)
        self._simulated = False
        self._link = Link(
            chosen.namespace,
            chosen.domain_id,
            chosen.command_topic,
            stamped=True if chosen.gated else chosen.stamped,
            patience_s=chosen.timeout_s,
            parameters={"pose_type": chosen.pose_type, "imu": chosen.imu},
            command_timeout_s=math.inf  # a gate has its own timeout
            if chosen.gated
            else max(COMMAND_S, PERIODS * self._period_ns / NS_PER_S),
        )
        try:
            declare_sensors(self._link.node, self._commands_are_stamped())
            self._topics = RobotTopics(self._link.node, model, now_ns=time.monotonic_ns)
            self._episodes = EpisodeServices(self._link, chosen.simulator, model, world)
            self._link.begin()
            clients = self._episodes.clients if chosen.vehicle is False else []
            topics = self._topics.expected_topics
            self._link.wait_for_peers(topics, clients, chosen.timeout_s, ADVICE)
            # A simulator's services may be found later than its topics.
            if chosen.vehicle is None:
                holds(lambda: not self._is_vehicle(), SERVICES_S, POLL_S)
        except BaseException:
            self.close()
            raise

    def _commands_are_stamped(self) -> bool:
        if self._options.stamped is not None:
            return self._options.stamped
        if not self._options.gated:
            return self._link.stamped
        return self._link.hears_stamped(CMD_VEL, self._options.timeout_s)

    @halts_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin an episode by a simulator's service, or once a vehicle stands at the start."""
        self._link.check_open()
        self._link.halt()
        if self._is_vehicle():
            self._await_start(start)
            if self._options.lays_map:
                with self._topics.lock:
                    self._topics.place(start.pose)
        if not self._is_vehicle():
            timeout_s = self._options.timeout_s
            stamp_ns = self._episodes.begin(start, timeout_s)
            with self._topics.lock:
                self._topics.begin(stamp_ns, start.pose)
            if not holds(lambda: math.isfinite(self._oldest()[1]), timeout_s, POLL_S):
                raise StaleDataError(*self._oldest(), timeout_s)
        self._misses = 0
        self._deadline_ns = time.monotonic_ns() + self._period_ns
        return self._fresh_view()[0]

    def present_pose(self) -> Array:
        """Wait until the robot stands still, and return its pose (3,) in `map`."""
        self._link.check_open()
        self._await_start(None)
        with self._topics.lock:
            pose: Array = self._topics.view().pose
        return pose

    def _is_vehicle(self) -> bool:
        if self._options.vehicle is not None:
            return self._options.vehicle
        self._simulated = self._simulated or self._episodes.there
        return not self._simulated

    def _await_start(self, start: Start | None) -> None:
        say = self._options.say or self._link.node.get_logger().info
        began = time.monotonic()
        said = -math.inf
        while (start is None or self._is_vehicle()) and (
            missing := self._missing(start)
        ):
            now = time.monotonic()
            if now - began > self._options.start_timeout_s:
                late = (
                    f"after {self._options.start_timeout_s:g} s the robot is not ready"
                )
                raise BackendError(
                    f"{late}: {missing}; place it there, or choose start='present'."
                )
            if now - said >= SAY_EVERY_S:
                say(f"waiting for the robot: {missing}")
                said = now
            time.sleep(POLL_S)

    def _missing(self, start: Start | None) -> str:
        """Return what is missing to begin at `start`, or anywhere if None; empty for nothing."""
        topic, silence_s = self._oldest()
        if math.isinf(silence_s):
            return f"no {topic} yet"
        if silence_s > self._options.stale_after_s:
            return f"no {topic} for {silence_s:.1f} s"
        with self._topics.lock:
            view = self._topics.view()
        if abs(view.twist[2]) > STILL[1] or math.hypot(*view.twist[:2]) > STILL[0]:
            return "it is still moving"
        if start is None or self._options.start == "present":
            return ""
        off = geometry.between(view.pose, start.pose)
        distance = math.hypot(*off[:2])
        turn = math.degrees(abs(off[2]))
        if (
            distance <= self._options.tolerance[0]
            and abs(off[2]) <= self._options.tolerance[1]
        ):
            return ""
        x, y, heading = start.pose
        return (
            f"it is {distance:.2f} m and {turn:.0f} deg off its start "
            f"({x:.2f} m, {y:.2f} m, {math.degrees(heading):.0f} deg)"
        )

    def _oldest(self) -> tuple[str, float]:
        """Return the topic that has been silent for longest, and how long [s]; inf: always.

        After a clock jump no datum is left, but the arrival time of the last one is still known.
        """
        now_ns = time.monotonic_ns()
        with self._topics.lock:
            cache = self._topics.middleware.cache
            newest = dict(cache.newest)
            arrived_ns = {topic: times[-1] for topic, times in cache.arrivals.items()}
        latest_ns = max((datum.stamp_ns for datum in newest.values()), default=0)
        silences = dict.fromkeys(self._topics.expected, math.inf)
        for topic in self._topics.expected:
            if topic in newest:
                behind_ns = latest_ns - newest[topic].stamp_ns
                silences[topic] = (
                    max(now_ns - newest[topic].arrival_ns, behind_ns) / NS_PER_S
                )
            elif topic in arrived_ns:
                silences[topic] = (now_ns - arrived_ns[topic]) / NS_PER_S
        oldest = max(silences, key=lambda topic: silences[topic])
        return oldest, silences[oldest]

    def _missing_topic(self) -> str | None:
        """Return a topic without a datum on the present clock, or None if there is none."""
        with self._topics.lock:
            there = self._topics.middleware.cache.newest.keys()
            return next(
                (topic for topic in self._topics.expected if topic not in there), None
            )

    @halts_on_error
    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish a command and wait for the end of its period; see `interface.Backend`."""
        self._link.check_open()
        # A command carries the stamp of the scan that it was computed from, not of the newest scan.
        self._link.send(self._robot.to_cmd_vel(command), self._scan_ns)
        late_ns = time.monotonic_ns() - self._deadline_ns
        if late_ns > 0:
            missed = late_ns // self._period_ns + 1
            self._misses += missed
            self._deadline_ns += missed * self._period_ns
        while (left_ns := self._deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)
        self._deadline_ns += self._period_ns
        return self._fresh_view()

    def _fresh_view(self) -> tuple[RobotView, dict[str, Any]]:
        """Return the present view; after a clock jump, wait until all topics have arrived again."""
        limit_s = self._options.stale_after_s
        holds(lambda: self._missing_topic() is None, limit_s, POLL_S)
        with self._topics.lock:
            missing = self._missing_topic()
            topic, age_s = self._oldest()
            if missing is None and age_s <= limit_s:
                facts = data_facts(self._topics.middleware, time.monotonic_ns())
                self._scan_ns = self._topics.middleware.cache.newest[SCAN].stamp_ns
                self._link.frame = self._topics.frames[1]
                view = self._topics.view()
                known = {
                    "stamp_ns": self._topics.newest_ns,
                    "deadline_misses": self._misses,
                }
                return view, known | facts
        raise StaleDataError(topic, age_s, limit_s)

    def facts(self) -> BackendFacts:
        """Return nothing: the topics carry all that is known."""
        return {}

    def halt(self) -> None:
        """Publish a zero command."""
        self._link.halt()

    def close(self) -> None:
        """Publish a zero command and end the node."""
        self._link.close()
