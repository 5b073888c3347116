"""RealtimeBackend: a vehicle, or a simulator on the wall clock, as a synchronous backend.

`reset` begins an episode: a simulator is reset by its services, a vehicle is awaited at the start.
`step` publishes a command, waits for the end of the period on the steady clock, and returns the
newest view. The executor's thread feeds the topics into the middleware in the meantime.
"""

import math
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.config import Schema, validate
from nics_drl_bridge.env.guard import stop_on_error
from nics_drl_bridge.errors import BackendError, StaleDataError
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array, BackendFacts, RobotView, Start
from nics_drl_bridge.middleware.ekf import START_STD
from nics_drl_bridge.middleware.measurement import CMD_VEL, SCAN
from nics_drl_bridge.middleware.middleware import rehearse
from nics_drl_bridge.nodes.link import EpisodeServices, Link
from nics_drl_bridge.nodes.listener import holds
from nics_drl_bridge.nodes.parameters import NO_POSE, STAMPED
from nics_drl_bridge.nodes.robot_topics import RobotTopics
from nics_drl_bridge.nodes.runner import declare_rows
from nics_drl_bridge.sim.world_set import AnyWorld

POLL_S = 0.01
# Interval between two reports of what is missing for the start [s].
SAY_EVERY_S = 2.0
# A peer without services this long after its topics appeared is a vehicle [s].
SERVICES_S = 0.5
# A command also lasts for this number of periods before a zero command follows.
COMMAND_PERIODS = 2
# A robot below these speeds is at rest.
REST_SPEED = 0.02  # [m/s]
REST_YAW_RATE = 0.05  # [rad/s]
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
    # age above which data are too old for a view
    stale_after_s: PositiveFloat = defaults.DATA_SILENCE_S
    # On a vehicle, wait until it stands at the requested pose, or start at the present one.
    start: Literal["wait", "present"] = defaults.VEHICLE_START
    # Lay `map` so that the robot's present pose is the start; with `present` and without a pose
    # sensor only.
    lays_map: bool = False
    # tolerance of the start pose [m, rad]
    tolerance: tuple[PositiveFloat, PositiveFloat] = (0.1, 0.1)
    start_timeout_s: PositiveFloat = 300.0  # longest wait for the start
    # receives what is missing for the start; the node's logger by default
    say: Callable[[str], None] | None = None
    # With `cmd_vel_raw`, commands pass `command_gate`: each is a TwistStamped with the stamp of the
    # scan that it answers.
    command_topic: str = Field(CMD_VEL, min_length=1)
    # use TwistStamped for `cmd_vel`; None: the type to which the robot subscribes
    stamped: bool | None = None
    pose_type: str = (
        defaults.POSE_TYPE
    )  # message type of `pose`, a pose sensor in `map`
    # Topic of the gyro for the yaw rate; `auto`: the usual topics, if the model was made with one
    imu: str = Field(defaults.IMU_TOPIC, min_length=1)

    @model_validator(mode="after")
    def _check_map(self) -> "RealtimeOptions":
        if self.lays_map and self.start != "present":
            raise ValueError("lays_map needs start='present': leave one of them out")
        if self.lays_map and self.pose_type != NO_POSE:
            raise ValueError(
                "lays_map is for a robot without a pose sensor: leave it out"
            )
        return self

    @property
    def gated(self) -> bool:
        """True if commands pass a `command_gate`."""
        return self.command_topic.rsplit("/", 1)[-1] == inputs.RAW


class RealtimeBackend:
    """One robot behind its topics, stepped at a fixed period of the steady clock.

    Deadlines that a late caller misses are counted, not made up for.

    Args:
        model: the robot's model.
        world: the world of the episodes, which a simulator has to run, too.
        options: `RealtimeOptions`.

    Raises:
        ConfigError: if an option can't be used.
        BackendError: if there is no peer, or it refuses, or a vehicle does not get ready to start.
        ModelError: if a simulator runs another model or world.
        StaleDataError: if data are older than `stale_after_s`, or do not arrive within `timeout_s`
            after the reset of a simulator.
    """

    def __init__(self, model: SimulatorModel, world: AnyWorld, **options: Any) -> None:
        chosen = validate(options, RealtimeOptions, "backend_options")
        self._options = chosen
        self._robot = model.robot
        self._period_ns = round((chosen.period_s or model.control_period) * NS_PER_S)
        self._deadline_ns = 0  # end of the present period, on the steady clock
        self._misses = 0  # deadlines missed in this episode
        self._scan_ns = 0  # stamp of the scan in the newest view [ns]
        self._has_seen_services = False  # those of a simulator
        command_timeout_s = max(
            defaults.COMMAND_SILENCE_S, COMMAND_PERIODS * self._period_ns / NS_PER_S
        )
        if chosen.gated:
            command_timeout_s = math.inf  # a gate has its own timeout
        model.robot.require_cmd_vel()
        rehearse(model)
        self._link = Link(
            chosen.namespace,
            chosen.domain_id,
            chosen.command_topic,
            stamped=True if chosen.gated else chosen.stamped,
            patience_s=chosen.timeout_s,
            parameters={"pose_type": chosen.pose_type, "imu": chosen.imu},
            command_timeout_s=command_timeout_s,
        )
        try:
            # the robot itself gets stamped commands, maybe from a gate
            stamped = chosen.stamped
            if stamped is None and chosen.gated:
                stamped = self._link.expects_stamped(CMD_VEL, chosen.timeout_s)
            elif stamped is None:
                stamped = self._link.stamped
            known = {STAMPED: stamped}
            declare_rows(self._link.node, "sensors", "stamped", **known)
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

    @stop_on_error
    def reset(self, start: Start) -> RobotView:
        """Begin an episode by a simulator's services, or once a vehicle is ready at the start."""
        self._link.check_open()
        self._link.halt()
        if self._is_vehicle():
            self._wait_until_ready(start)
        # A simulator's services may be found only during that wait.
        if not self._is_vehicle():
            timeout_s = self._options.timeout_s
            stamp_ns = self._episodes.begin(start, timeout_s)
            with self._topics.lock:
                self._topics.begin(stamp_ns, start.pose)

            def find_unheard() -> list[str]:
                silences_s = self._measure_silences()
                return [topic for topic, s in silences_s.items() if math.isinf(s)]

            holds(lambda: not find_unheard(), timeout_s, POLL_S)
            for topic in find_unheard():
                raise StaleDataError(topic, math.inf, timeout_s)
        elif self._options.lays_map:
            with self._topics.lock:
                self._topics.place(start.pose, START_STD**2 * np.eye(3))
        self._misses = 0
        self._deadline_ns = time.monotonic_ns() + self._period_ns
        view, _ = self._take_view()
        return view

    @stop_on_error
    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publish a command and wait for the end of its period; see `interface.Backend`."""
        self._link.check_open()
        # A command carries the stamp of the scan that it was computed from, not of the newest scan.
        self._link.send(self._robot.to_cmd_vel(command), self._scan_ns)
        self._wait_for_deadline()
        return self._take_view()

    def _wait_for_deadline(self) -> None:
        """Wait for the end of the period, or if the caller missed it, for the next one."""
        late_ns = time.monotonic_ns() - self._deadline_ns
        if late_ns > 0:
            missed = late_ns // self._period_ns + 1
            self._misses += missed
            self._deadline_ns += missed * self._period_ns
        left_ns = self._deadline_ns - time.monotonic_ns()
        while left_ns > 0:
            time.sleep(left_ns / NS_PER_S)
            left_ns = self._deadline_ns - time.monotonic_ns()
        self._deadline_ns += self._period_ns

    def _take_view(self) -> tuple[RobotView, dict[str, Any]]:
        """Return the present view, and `info`. Raises StaleDataError if a topic is silent.

        After a clock jump, wait until all topics have arrived again.
        """
        limit_s = self._options.stale_after_s

        def find_missing() -> list[str]:
            with self._topics.lock:
                newest = self._topics.middleware.cache.newest
                return [t for t in self._topics.expected if t not in newest]

        holds(lambda: not find_missing(), limit_s, POLL_S)
        with self._topics.lock:
            silences_s = self._measure_silences()
            missing = find_missing()
            longest = max(silences_s, key=lambda topic: silences_s[topic])
            topic = missing[0] if missing else longest
            if missing or silences_s[topic] > limit_s:
                raise StaleDataError(topic, silences_s[topic], limit_s)
            info = {
                "stamp_ns": self._topics.newest_ns,
                "deadline_misses": self._misses,
            }
            info |= self._topics.middleware.list_facts(time.monotonic_ns())
            self._scan_ns = self._topics.middleware.cache.newest[SCAN].stamp_ns
            _, self._link.frame = self._topics.frames
            return self._topics.view(), info

    def _measure_silences(self) -> dict[str, float]:
        """Return how long each topic has been silent [s]; inf for one that was never heard.

        A topic is silent since its newest datum arrived, but at least for as long as that datum's
        stamp is behind the newest stamp of all topics. After a clock jump no datum is left, but the
        arrival time of the last one is still known.
        """
        now_ns = time.monotonic_ns()
        silences_s = {}
        with self._topics.lock:
            cache = self._topics.middleware.cache
            latest_ns = self._topics.newest_ns
            for topic in self._topics.expected:
                silence_s = cache.silence_s(topic, now_ns)
                if topic in cache.newest:
                    behind_ns = latest_ns - cache.newest[topic].stamp_ns
                    silence_s = max(silence_s, behind_ns / NS_PER_S)
                silences_s[topic] = silence_s
        return silences_s

    def _is_vehicle(self) -> bool:
        if self._options.vehicle is not None:
            return self._options.vehicle
        if self._episodes.there:
            self._has_seen_services = True
        return not self._has_seen_services

    def present_pose(self) -> Array:
        """Wait until the robot stands still, and return its pose (3,) in `map`."""
        self._link.check_open()
        self._wait_until_ready(None)
        with self._topics.lock:
            pose: Array = self._topics.view().pose
        return pose

    def _wait_until_ready(self, start: Start | None) -> None:
        """Wait until the robot can begin at `start`, or anywhere if None; report what is missing.

        The wait for a `start` also ends if the robot turns out to be in a simulator. Raises
        BackendError after `start_timeout_s`, or if the backend is closed meanwhile.
        """
        say = self._options.say or self._link.node.get_logger().info
        timeout_s = self._options.start_timeout_s
        deadline = time.monotonic() + timeout_s
        next_report = -math.inf
        while True:
            self._link.check_open()
            if start is not None and not self._is_vehicle():
                return
            hindrance = self._find_hindrance(start)
            if hindrance is None:
                return
            reason, fix = hindrance
            now = time.monotonic()
            if now > deadline:
                raise BackendError(
                    f"after {timeout_s:g} s the robot is not ready: {reason}; {fix}."
                )
            if now >= next_report:
                say(f"waiting for the robot: {reason}")
                next_report = now + SAY_EVERY_S
            time.sleep(POLL_S)

    def _find_hindrance(self, start: Start | None) -> tuple[str, str] | None:
        """Return what keeps the robot from beginning at `start`, or anywhere if None, and a fix."""
        silences_s = self._measure_silences()
        topic = max(silences_s, key=lambda topic: silences_s[topic])
        fix = "check that its publisher runs in this ROS domain and namespace"
        if math.isinf(silences_s[topic]):
            return f"no {topic} yet", fix
        if silences_s[topic] > self._options.stale_after_s:
            return f"no {topic} for {silences_s[topic]:.1f} s", fix
        with self._topics.lock:
            view = self._topics.view()
        vx, vy, yaw_rate = view.twist
        if abs(yaw_rate) > REST_YAW_RATE or math.hypot(vx, vy) > REST_SPEED:
            return "it is still moving", "stop whatever else drives it"
        if start is None or self._options.start == "present":
            return None
        dx, dy, turn = geometry.between(view.pose, start.pose)
        distance = math.hypot(dx, dy)
        max_distance, max_turn = self._options.tolerance
        if distance <= max_distance and abs(turn) <= max_turn:
            return None
        x, y, heading = start.pose
        reason = (
            f"it is {distance:.2f} m and {math.degrees(abs(turn)):.0f} deg off its start "
            f"({x:.2f} m, {y:.2f} m, {math.degrees(heading):.0f} deg)"
        )
        return reason, "place it there, or choose start='present'"

    def facts(self) -> BackendFacts:
        """Return nothing: the topics carry all that is known."""
        return {}

    def halt(self) -> None:
        """Publish a zero command."""
        self._link.halt()

    def close(self) -> None:
        """Publish a zero command and end the node."""
        self._link.close()
