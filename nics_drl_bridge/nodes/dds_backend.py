"""DdsBackend: the robot behind ROS 2 topics, as the same synchronous backend.

Two threads that take turns on one core.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.errors import BackendError, StaleDataError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, BackendFacts, RobotView, Start
from nics_drl_bridge.lidar.spec import from_device
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.executor import HANDED_OVER
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.observer import EpisodeServices
from nics_drl_bridge.nodes.robot_topics import data_facts
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]
T = TypeVar("T")
SCAN, ODOM, TRUTH = "scan", "odom", "ground_truth"
AGAIN_S = 0.05
"""Data that do not arrive within this time are requested again [s]."""
ADVICE = "start `simulator_node` with mode:=lockstep in the same ROS_DOMAIN_ID and namespace."


class _Mailbox:
    """The newest message of each topic, serialised, from the executor's thread to the caller's.

    The caller is woken once, when all that it waits for is there: each wake-up costs a good part
    of a step. Odometry that it waits for is processed by the executor's thread, while the scan is
    still in transit.

    Args:
        topics: that the caller waits for.
        work: called with stamp [ns], arrival [ns] and message of an odometry.
    """

    def __init__(self, topics: tuple[str, ...], work: Callable[[int, int, bytes], None]) -> None:
        self._topics, self._work = topics, work
        self._messages: dict[str, bytes] = {}
        self._stamps = dict.fromkeys(topics, -1)
        self._arrivals: dict[str, int] = {}
        self._lock, self._complete = threading.Lock(), threading.Event()
        self._awaited_ns, self._worked_ns = -1, -1
        self._failure: Exception | None = None
        self._core = OneCore()

    def put(self, topic: str, message: bytes) -> object:
        """Takes a message; returns `HANDED_OVER` if the caller now continues."""
        self._core.help()
        with self._lock:
            try:
                self._stamps[topic] = _read(topic, wire.stamp_of, message)
                self._messages[topic], self._arrivals[topic] = message, time.monotonic_ns()
                self._work_in()
            except Exception as error:  # noqa: BLE001  (it is raised in the caller's thread)
                self._failure = error
            if self._awaited_ns >= 0 and (self._failure is not None or self._late() is None):
                self._complete.set()
                return HANDED_OVER
        return None

    def _work_in(self) -> None:
        """Processes the awaited odometry, once."""
        awaited = self._awaited_ns
        if self._stamps[ODOM] == awaited != self._worked_ns:
            self._worked_ns = awaited
            self._work(awaited, self._arrivals[ODOM], self._messages[ODOM])

    def _late(self) -> str | None:
        """Returns the first topic whose newest message is older than awaited; None if none is."""
        for topic in self._topics:
            if self._stamps[topic] < self._awaited_ns:
                return topic
        return None

    def stamp_ns(self, topic: str) -> int:
        """Returns the stamp of the newest message [ns]; -1 if there is none."""
        return self._stamps[topic]

    def age_s(self, topic: str) -> float:
        """Returns the seconds since the newest message arrived; inf if there is none."""
        arrival_ns = self._arrivals.get(topic)
        return math.inf if arrival_ns is None else (time.monotonic_ns() - arrival_ns) * 1e-9

    def wait(self, stamp_ns: int, timeout_s: float) -> dict[str, tuple[bytes, int]]:
        """Returns message and arrival [ns] of each topic, once each is at least as new as a stamp.

        Raises:
            StaleDataError: a message does not arrive.
        """
        with self._lock:
            self._awaited_ns, self._failure = stamp_ns, None
            self._complete.clear()
            self._work_in()
            late = self._late()
        if late is not None:
            self._core.wait(self._complete, timeout_s)
        with self._lock:
            self._awaited_ns = -1
            if self._failure is not None:
                raise self._failure
            for topic in self._topics:
                if self._stamps[topic] < stamp_ns:
                    raise StaleDataError(topic, self.age_s(topic), timeout_s)
            return {t: (message, self._arrivals[t]) for t, message in self._messages.items()}


def _worker(middleware: Middleware) -> Callable[[int, int, bytes], None]:
    """Returns the callback for odometry, without a reference to the backend (it may be garbage)."""

    def work(stamp_ns: int, arrival_ns: int, message: bytes) -> None:
        middleware.odometry(stamp_ns, arrival_ns, *_read(ODOM, wire.odometry_of, message))

    return work


class DdsBackend:
    """One robot behind `cmd_vel`, `scan` and `odom`, in lock-step with a simulator node.

    Each step publishes one command and returns exactly the data that are stamped one control
    period later. Its own node in its own context listens in one executor thread; nothing spins
    inside `step`. `close`, an error in `step` and garbage collection leave a zero command behind,
    see `Link`. A vehicle, or a simulator in real time, needs `RealtimeBackend`, selected by
    `mode="realtime"` in `backend_options`.

    Args:
        model: must be the one that the simulator node runs.
        world: likewise.
        namespace: of the robot.
        simulator: name of the simulator's node in that namespace.
        timeout_s: longest wait for a peer or an answer [s].
        truth: whether to wait for `ground_truth` too, and put the true pose into `info`.
        domain_id: DDS domain; the environment's by default.

    Raises:
        BackendError: no simulator is there.
    """

    def __init__(
        self,
        model: SimulatorModel,
        world: World,
        namespace: str = "",
        simulator: str = "simulator_node",
        timeout_s: float = 30.0,
        truth: bool = False,
        domain_id: int | None = None,
    ) -> None:
        self._robot, self._lidar = model.robot, model.lidar
        self._middleware = Middleware(model)
        self._period_ns = round(model.control_period * NS_PER_S)
        self.timeout_s, self._topics = timeout_s, (ODOM, SCAN, *((TRUTH,) if truth else ()))
        self._now_ns, self._mail = 0, _Mailbox(self._topics, _worker(self._middleware))
        self._known: BackendFacts = {}
        self._link = Link(namespace, domain_id)
        types = {SCAN: LaserScan, ODOM: Odometry, TRUTH: Odometry}
        for topic in self._topics:
            self._link.node.create_subscription(
                types[topic], topic, _putter(self._mail, topic), qos.SENSOR, raw=True
            )
        self._episodes = EpisodeServices(self._link, simulator, model, world)
        self._link.begin()
        try:
            self._link.wait_for_peers(self._topics, self._episodes.clients, timeout_s, ADVICE)
        except BaseException:
            self.close()
            raise

    def reset(self, start: Start) -> RobotView:
        """Begins the episode of a seed in the simulator; see `interface.Backend`.

        Raises:
            BackendError: the simulator refuses, or does not answer.
            ModelError: it runs another model or world.
            StaleDataError: its data do not arrive.
        """
        with self._link.zero_after_an_error():
            self.choose(start)
            return self.first(self.begin(), start.pose)

    def choose(self, start: Start) -> None:
        """The first part of a reset: chooses the episode for `begin`."""
        self._link.check_open()
        self._link.check_alone()
        self._episodes.choose(start, self.timeout_s)

    def begin(self) -> int:
        """The second part: begins it, and returns the stamp of its first data [ns]."""
        return self._episodes.begin(self.timeout_s)

    def first(self, stamp_ns: int, pose: Array) -> RobotView:
        """The last part: waits for the data of a stamp, of a robot that stands at a pose (3,)."""
        self._now_ns = stamp_ns
        self._middleware.reset(stamp_ns, pose)
        return self._measure()[0]

    def step(self, command: Array) -> tuple[RobotView, dict[str, Any]]:
        """Publishes a command and waits for the data after it; see `interface.Backend`.

        Raises:
            BackendError: another node moved the simulator, or it is not in lock-step.
            StaleDataError: the data do not arrive.
        """
        self.send(command)
        return self.receive()

    def send(self, command: Array) -> None:
        """The first half of a step: checks and publishes a command (C,)."""
        self._link.check_open()
        with self._link.zero_after_an_error():
            # Data that arrived before the command would be taken for its answer.
            self._check_stamps()
            twist = self._robot.to_cmd_vel(command)
            self._link.send(twist)
            # Checked while the simulator is at work.
            self._link.check_alone()
            self._middleware.command(self._now_ns, self._robot.from_cmd_vel(twist))
            self._now_ns += self._period_ns
            self._middleware.foresee(self._now_ns)

    def receive(self) -> tuple[RobotView, dict[str, Any]]:
        """The second half: waits for the data after the command; returns the view and `info`."""
        with self._link.zero_after_an_error():
            return self._measure()

    def _check_stamps(self) -> None:
        for topic in self._topics:
            self._check_stamp(topic)

    def _check_stamp(self, topic: str) -> None:
        """Raises BackendError if the newest datum is not stamped with the present step."""
        off_ns = self._mail.stamp_ns(topic) - self._now_ns
        if off_ns:
            self._link.check_alone()
            raise BackendError(
                f"topic {topic!r}: stamped {off_ns / NS_PER_S:+.3f} s off the step; start "
                "the simulator with mode:=lockstep, and move it from here alone."
            )

    def _measure(self) -> tuple[RobotView, dict[str, Any]]:
        """Returns the view at the present stamp. Raises BackendError if the data have another."""
        now = self._now_ns
        messages = self._await(now)
        self._check_stamps()
        message, arrival = messages[SCAN]
        ranges = from_device(_read(SCAN, wire.ranges_of, message), self._lidar)
        self._middleware.scan(now, arrival, ranges)
        facts: dict[str, Any] = {
            "stamp_ns": now,
            **data_facts(self._middleware, time.monotonic_ns()),
        }
        if TRUTH in self._topics:
            facts["true_pose"] = _read(TRUTH, wire.odometry_of, messages[TRUTH][0])[0]
            self._known = {"true_pose": facts["true_pose"]}
        return self._middleware.view(now), facts

    def _await(self, stamp_ns: int) -> dict[str, tuple[bytes, int]]:
        """Returns the mailbox's data for a stamp; what does not arrive is requested again.

        Data may be lost, and those sent before the simulator discovered a subscription always are.
        """
        deadline = time.monotonic() + self.timeout_s
        while True:
            try:
                left_s = max(0.0, deadline - time.monotonic())
                return self._mail.wait(stamp_ns, min(AGAIN_S, left_s))
            except StaleDataError as error:
                if left_s <= AGAIN_S:
                    raise StaleDataError(error.topic, error.age_s, self.timeout_s) from None
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
    """Returns the content of a message. Raises BackendError if it is not of that type."""
    try:
        return read(message)
    except wire.UNREADABLE as error:
        raise BackendError(
            f"topic {topic!r}: a message can't be read ({error}); look at who publishes it."
        ) from None


def _putter(mail: _Mailbox, topic: str) -> Callable[[bytes], object]:
    return lambda message: mail.put(topic, message)


try:
    _core_now = ctypes.PyDLL(None).sched_getcpu
    _allowed, _allow = os.sched_getaffinity, os.sched_setaffinity
    CAN_CHOOSE = True
except (AttributeError, TypeError):  # no Linux with glibc
    CAN_CHOOSE = False


class OneCore:
    """Keeps a waiting thread, and the helper that it waits for, on one core during the wait.

    So no thread has to be woken on another core that sleeps, which on a virtual machine takes about
    a tenth of a lock-step step for each of the two. The helper follows the waiting thread wherever
    the system moves it. After the wait, that thread may run anywhere again, so that threads that it
    starts do not inherit anything.

    If the system does not let threads choose, this only waits.
    """

    def __init__(self) -> None:
        self._helper, self._place = 0, (0, -1)

    def help(self) -> None:
        """Registers the calling thread as the helper."""
        self._helper = threading.get_native_id()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Waits for an event; returns whether it came within a time [s]."""
        cores = _allowed(0) if CAN_CHOOSE and self._helper else set()
        if len(cores) < 2:
            return event.wait(timeout_s)
        try:
            self._share()
            return event.wait(timeout_s)
        finally:  # also if interrupted in the middle of it
            with contextlib.suppress(OSError):
                _allow(0, cores)

    def _share(self) -> None:
        # The helper may have ended, and the system may restrict the cores.
        with contextlib.suppress(OSError, ValueError):
            core = _core_now()
            if self._place != (self._helper, core):
                _allow(self._helper, {core})
                self._place = self._helper, core
            _allow(0, {core})
