"""Episodes of the shield over DDS in real time: a `command_gate` process for each of some robots.

This process is the robots: it moves their worlds by the wall clock, publishes what their devices
would, at the lidar's rate, and hears `cmd_vel`. The gates are processes of their own with their
shipped parameters.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from nics_drl_bridge.gate.assurance.place import STEP_S, Job, Outcome, Place
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import open_context
from nics_drl_bridge.nodes.processes import NodeProcess, free_domain_id

Array = NDArray[np.float64]
REST_S = 1.3
SILENCE_S = 0.5
SCAN_STEPS = 5
PATIENCE_S = 120.0
BEHIND_S = 0.15
"""When this process itself was held up for longer, no base kept the latency that its shield was
told: the worlds stood still meanwhile, and the running episodes are driven again."""
TRIES = 10
"""So often is an episode begun at most."""
VARIANCES = (1e-4,) * 4
GATE = "command_gate"
LATCHED = re.compile(r"(?:call ~/reset first: |e_stop_released: )(\w+)")
"""What a gate that refuses to be armed says of a stop that waits for a reset."""


@dataclass
class HeldUp:
    """How well this process kept up with the clock while robots drove.

    Attributes:
        count: how often it was held up.
        seconds: for how long in all [s].
        of_s: of so many that it ran [s].
        repeated: episodes that were restarted for that.
    """

    count: int = 0
    seconds: float = 0.0
    of_s: float = 0.0
    repeated: int = 0

    def add(self, more: HeldUp) -> None:
        """Sums up."""
        self.count = self.count + more.count
        self.seconds = self.seconds + more.seconds
        self.of_s = self.of_s + more.of_s
        self.repeated = self.repeated + more.repeated


class Lane:
    """One robot behind its topics, and the episodes that it is to drive.

    Args:
        node: that speaks for it.
        name: its namespace.
        place: its robot and world.
        jobs: its episodes.

    Attributes:
        outcomes: of those that were driven.
    """

    def __init__(
        self, node: Node, name: str, place: Place, jobs: Sequence[Job]
    ) -> None:
        self.place = place
        self.outcomes = list[Outcome]()
        self._jobs = deque(jobs)
        self._told = np.zeros(3)
        self._told_s = -np.inf
        self._begun_s = np.inf
        self._scan, self._odom, self._estimate, self._e_stop, self._raw = (
            node.create_publisher(kind, f"{name}/{topic}", qos.COMMAND)
            for kind, topic in (
                (LaserScan, "scan"),
                (Odometry, "odom"),
                (Odometry, "odometry/filtered"),
                (Bool, "e_stop"),
                (TwistStamped, "cmd_vel_raw"),
            )
        )
        node.create_subscription(Twist, f"{name}/cmd_vel", self._hear, qos.COMMAND)
        self._clients = {
            service: node.create_client(Trigger, f"{name}/{GATE}/{service}")
            for service in ("arm", "reset")
        }
        self._asked: Future | None = None
        self._asks = "arm"
        self._driving = False
        self._rested = 0
        self._tries = 1
        self.refused = "nobody answers"
        if self._jobs:
            place.begin(self._jobs[0])

    @property
    def done(self) -> bool:
        """Whether all episodes were driven."""
        return not self._jobs

    def _hear(self, message: Twist) -> None:
        now = time.monotonic()
        outcome = self.place.outcome
        if self._driving:
            outcome.silence = max(
                outcome.silence, now - max(self._told_s, self._begun_s)
            )
        self._told = conversions.twist_from_ros(message)
        self._told_s = now

    def step(self, stamp_ns: int, speaks: bool) -> None:
        """Moves on by a step, and says what the robot's devices would, if it is time."""
        silent = time.monotonic() - self._told_s > SILENCE_S
        if self._driving:
            self.place.step(np.zeros(3) if silent else self._told)
            if self.place.ended:
                self._end()
        elif not self.done:
            self._rested += 1
            if self._rested * STEP_S >= REST_S:
                self._arm()
        if speaks:
            self._say(stamp_ns)

    def _say(self, stamp_ns: int) -> None:
        truth = self.place.truth
        model = self.place.model
        twist = truth.twist if self._driving else np.zeros(3)
        odometry = conversions.odometry_to_ros(
            self.place.odom, twist, stamp_ns, ("odom", "base_link"), VARIANCES
        )
        self._odom.publish(odometry)
        self._estimate.publish(odometry)
        self._scan.publish(
            conversions.scan_to_ros(model.lidar, truth.ranges, stamp_ns, "laser")
        )
        self._e_stop.publish(Bool(data=False))
        wish = self.place.wish(truth) if self._driving else np.zeros(3)
        command = TwistStamped(twist=conversions.twist_to_ros(wish))
        command.header.stamp = conversions.stamp_to_ros(stamp_ns)
        self._raw.publish(command)

    def _arm(self) -> None:
        """Asks the gate until it is armed; what it latched in the episode before is counted."""
        if self._asked is None:
            client = self._clients[self._asks]
            if client.service_is_ready():
                self._asked = client.call_async(Trigger.Request())
            return
        if not self._asked.done():
            return
        answer = self._asked.result()
        asked = self._asks
        self._asked = None
        self._asks = "arm"
        if asked == "arm" and answer.success:
            self._driving, self._begun_s = True, time.monotonic()
        elif found := LATCHED.search(answer.message):
            self._asks = "reset"
            if self.outcomes:
                self.outcomes[-1].latched = found[1]
        self.refused = answer.message

    def _end(self) -> None:
        self.outcomes.append(self.place.outcome)
        self._next()

    def _next(self) -> None:
        self._jobs.popleft()
        self._tries = 1
        self._rest()

    def void(self) -> bool:
        """Restarts the running episode, if there is one, or gives it up at last."""
        if not self._driving:
            return False
        if self._tries < TRIES:
            self._tries += 1
            self._rest()
        else:
            self._next()
        return True

    def _rest(self) -> None:
        self._driving = False
        self._rested = 0
        if self._jobs:
            self.place.begin(self._jobs[0])

    def close(self) -> None:
        """Leaves the robot's topics quiet."""
        self._jobs.clear()
        self._driving = False


def drive(
    places: Sequence[Place],
    jobs: Sequence[Sequence[Job]],
    parameters: Mapping[str, Any],
    folder: Path,
    tell: Callable[[str], None],
) -> tuple[list[Outcome], HeldUp]:
    """Drives the episodes of each place, all places side by side.

    Args:
        places: robots in their worlds.
        jobs: of each.
        parameters: of the gates, beside `model` and `limits`.
        folder: for their logs.
        tell: gets a line about the progress now and then.

    Returns:
        How the episodes went, and how well this process kept up.

    Raises:
        RuntimeError: a gate can't be armed.
    """
    domain_id = free_domain_id()
    with ExitStack() as stack:
        context = open_context(domain_id=domain_id)
        stack.callback(context.try_shutdown)
        node = Node("robots", context=context, start_parameter_services=False)
        stack.callback(node.destroy_node)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        lanes = []
        gates = []
        for index, (place, some) in enumerate(zip(places, jobs, strict=True)):
            name = f"robot{index + 1}"
            logs = folder / f"robot{index + 1}"
            given = {
                "model": place.robot,
                "limits": place.robot,
                "e_stop_required": True,
            }
            given |= {
                "black_box": str(logs / "black_box"),
                "enable_stamped_cmd_vel": False,
            }
            given |= parameters
            gates.append(
                stack.enter_context(NodeProcess(GATE, logs, given, domain_id, name))
            )
            lanes.append(Lane(node, name, place, some))
        held_up = _run(lanes, gates, executor, tell)
        for lane in lanes:
            lane.close()
    return [one for lane in lanes for one in lane.outcomes], held_up


def _run(
    lanes: Sequence[Lane],
    gates: Sequence[NodeProcess],
    executor: SingleThreadedExecutor,
    tell: Callable[[str], None],
) -> HeldUp:
    """Moves the worlds by the wall clock until all episodes are driven; how well it kept up."""
    epoch_ns = time.time_ns()
    began = time.monotonic()
    step = 0
    held_up = HeldUp()
    start = began
    last = began
    count = 0
    told = began
    while not all(lane.done for lane in lanes):
        ahead = began + step * STEP_S - time.monotonic()
        if ahead > 0.0:
            executor.spin_once(timeout_sec=ahead)
            continue
        if -ahead > BEHIND_S:
            began = began - ahead
            epoch_ns = epoch_ns - round(ahead * NS_PER_S)
            if voided := sum(
                lane.void() for lane in lanes
            ):  # not while the gates start
                held_up.add(HeldUp(1, -ahead, 0.0, voided))
        step_ns = epoch_ns + round(step * STEP_S * NS_PER_S)
        for index, lane in enumerate(lanes):
            lane.step(step_ns, speaks=(step + index) % SCAN_STEPS == 0)
        step += 1
        for _ in lanes:  # a command of each, also where there was no time to wait
            executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        driven = sum(len(lane.outcomes) for lane in lanes)
        if driven > count:
            count = driven
            last = now
        if now - told > 30.0:
            told = now
            waiting = {lane.refused for lane in lanes if not lane.done}
            tell(f"{driven} episodes after {now - start:.0f} s; {' | '.join(waiting)}")
        if now - last > PATIENCE_S:
            for gate in gates:
                gate.check()
            why = "; ".join(lane.refused for lane in lanes if not lane.done)
            raise RuntimeError(f"no episode ended within {PATIENCE_S} s: {why}")
    held_up.of_s = time.monotonic() - start
    return held_up
