"""CPU, memory and scan-to-command latency of a vehicle's nodes on this machine.

Middleware, policy and gate run as processes in a ROS domain of their own, where no robot receives
their commands. A stand-in robot publishes scans and odometry at fixed rates, and follows `cmd_vel`.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool

from nics_drl_bridge import geometry
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.gate import inputs
from nics_drl_bridge.generator import SimulatorModel, save_model
from nics_drl_bridge.interface import NS_PER_S, S_PER_NS
from nics_drl_bridge.middleware.measurement import CMD_VEL, ODOM, SCAN
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.core_share import CoreShare
from nics_drl_bridge.nodes.listener import Listener, holds
from nics_drl_bridge.nodes.operator import Call, TriggerAnswer, ask_until_granted
from nics_drl_bridge.nodes.parameters import STAMPED
from nics_drl_bridge.nodes.processes import NodeProcess, unused_domain_id
from nics_drl_bridge.robot.spec import RobotSpec

CORES = (1.0, 0.5, 0.25)
RATES = (10.0, 20.0)
SECONDS = 6.0
NAMESPACE = "nics_load"
GATE = f"/{NAMESPACE}/command_gate"
PATIENCE_S = 600.0  # kernels may have to be compiled
ARMING_S = 20.0
REPLY_S = 2.0
SETTLE_S = 0.5  # after a change of rate or share
POLL_S = 0.1
ROOM = 0.8  # radius of the room around the robot, as a fraction of the lidar's range
ROUGHNESS_M = 0.01  # of its walls, so that no two scans are the same
GOAL = [1e4, 0.0]  # never reached [m]


@dataclass(frozen=True)
class Latency:
    """Time from the stamp of a scan to a command [ms]; NaN if none came."""

    median_ms: float
    p99_ms: float


@dataclass(frozen=True)
class Load:
    """Measurement with one share of a core, at one rate."""

    cores: float  # share of one core that the three nodes had
    rate: float  # of scans and of odometry [Hz]
    scans: int
    answered: float  # fraction of the scans with a `cmd_vel_raw`
    cpu: dict[str, float]  # fraction of a core that each node used
    # of each node and its children, shared pages in part (PSS)
    memory_mb: dict[str, float]
    policy: Latency  # until `cmd_vel_raw`
    gate: Latency  # until the first `cmd_vel` after it


@dataclass(frozen=True)
class Record:
    """What the stand-in robot sent and received; times [ns] on the system clock."""

    scans: list[int] = field(default_factory=list)
    answers: dict[int, int] = field(default_factory=dict)  # by the stamp of the scan
    commands: list[int] = field(default_factory=list)


class StandIn(Listener):
    """A robot in a round room that moves with it; it follows `cmd_vel`."""

    def __init__(self, model: SimulatorModel, domain_id: int) -> None:
        super().__init__("stand_in", domain_id, NAMESPACE)
        self.record = Record()
        self._lidar = model.lidar
        self._rng = np.random.default_rng(0)
        self._pose = np.zeros(3)
        self._twist = np.zeros(3)
        self._time_ns = time.time_ns()
        quality = qos.SENSOR_RELIABLE
        self._scans = self.create_publisher(LaserScan, SCAN, quality)
        self._odometry = self.create_publisher(Odometry, ODOM, quality)
        self._e_stop = self.create_publisher(Bool, inputs.E_STOP, qos.COMMAND)
        self._readings = {
            sensor: self.create_publisher(
                conversions.find_sensor_type(sensor), sensor.name, quality
            )
            for sensor in model.sensors
        }
        for topic, take in ((inputs.RAW, self._take_answer), (CMD_VEL, self._take)):
            self.create_subscription(TwistStamped, topic, take, qos.EVERY_COMMAND)
        self._timer = self.create_timer(1.0 / self._lidar.rate, self._publish)

    def set_rate(self, rate: float) -> None:
        """Publish at another rate [Hz]."""
        self._timer.timer_period_ns = round(NS_PER_S / rate)

    def arm(self) -> None:
        """Stop, and arm the gate. Raises BackendError if it refuses."""

        def ask() -> TriggerAnswer:
            Call(self, GATE, "reset").wait_for_answer(REPLY_S)
            return Call(self, GATE, "arm").wait_for_answer(REPLY_S)

        deadline = time.monotonic() + ARMING_S
        answer = ask_until_granted(ask, deadline, lambda _: None, GATE)
        if not answer.granted:
            raise BackendError(f"the gate does not arm: {answer.told}.")

    def _publish(self) -> None:
        now_ns = time.time_ns()
        seconds = (now_ns - self._time_ns) * S_PER_NS
        self._time_ns = now_ns
        self._pose = geometry.compose(self._pose, geometry.exp(self._twist * seconds))
        frames = ("odom", "base_link")
        odometry = conversions.odometry_to_ros(
            self._pose, self._twist, now_ns, frames, (1e-4,) * 4
        )
        self._odometry.publish(odometry)
        for sensor, publisher in self._readings.items():
            reading = np.zeros(sensor.size, np.float32)
            publisher.publish(
                conversions.sensor_to_ros(sensor, reading, now_ns, sensor.frame)
            )
        wall = self._rng.normal(0.0, ROUGHNESS_M, self._lidar.beams)
        ranges = (ROOM * self._lidar.range_max + wall).astype(np.float32)
        self._scans.publish(
            conversions.scan_to_ros(self._lidar, ranges, now_ns, self._lidar.frame)
        )
        self.record.scans.append(now_ns)
        self._e_stop.publish(Bool(data=False))

    def _take_answer(self, message: TwistStamped, info: Any) -> None:
        stamp_ns = conversions.stamp_from_ros(message.header.stamp)
        self.record.answers[stamp_ns] = _get_arrival(info)

    def _take(self, message: TwistStamped, info: Any) -> None:
        self._twist = conversions.twist_from_ros(message)
        self.record.commands.append(_get_arrival(info))


def _get_arrival(info: Any) -> int:
    return int(info.get("received_timestamp") or time.time_ns())


def measure_load(
    model: SimulatorModel,
    policy: str,
    seconds: float = SECONDS,
    cores: Sequence[float] = CORES,
    rates: Sequence[float] = RATES,
    tell: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> tuple[list[Load], str]:
    """Run the nodes on one core, with shares of it, and measure them for a time [s] at each rate.

    Returns the measurements, and why the shares could not be limited, or "". Raises BackendError if
    a node ends or the gate does not arm.
    """
    if sys.platform != "linux":
        raise BackendError("the load of the nodes can only be measured on Linux.")
    loads: list[Load] = []
    unlimited = ""
    with ExitStack() as stack:
        group = None
        try:
            group = stack.enter_context(CoreShare())
        except OSError as error:
            unlimited = f"{error.filename}: {error.strerror}"
            cores = (1.0,)
        nodes, robot = stack.enter_context(_run_nodes(model, policy, group))
        plan = list(product(cores, rates))
        for share, rate in plan:
            tell(f"{share:g} of a core, {rate:g} Hz", len(loads), len(plan))
            robot.set_rate(model.lidar.rate)  # at another rate, the gate does not arm
            if group is not None:
                group.limit(1.0)
            robot.arm()
            robot.set_rate(rate)
            if group is not None:
                group.limit(share)
            time.sleep(SETTLE_S)
            loads.append(_measure(nodes, robot, share, rate, seconds))
    return loads, unlimited


@contextmanager
def _run_nodes(
    model: SimulatorModel, policy: str, group: CoreShare | None
) -> Iterator[tuple[list[NodeProcess], StandIn]]:
    """Run the nodes on one core, and a robot on the others if there are any."""
    domain_id = unused_domain_id()
    all_cores = os.sched_getaffinity(0)
    core = max(all_cores)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        stack.callback(os.sched_setaffinity, 0, all_cores)
        os.sched_setaffinity(0, {core})  # of this thread, and of what it starts
        nodes = [
            stack.enter_context(NodeProcess(node, folder, given, domain_id, NAMESPACE))
            for node, given in _choose_parameters(model, policy, folder).items()
        ]
        if group is not None:
            for node in nodes:
                group.add(node.pid)
        os.sched_setaffinity(0, all_cores - {core} or all_cores)
        robot = StandIn(model, domain_id)
        robot.start()
        stack.callback(robot.close)
        _wait_until_running(nodes)
        yield nodes, robot


def _choose_parameters(
    model: SimulatorModel, policy: str, folder: Path
) -> dict[str, dict[str, Any]]:
    save_model(model, folder / "model")  # a vehicle has its model in a folder, too
    limits = folder / "limits.yaml"
    limits.write_text(dump_yaml(_allow_all(model.robot)), encoding="utf-8")
    shared = {"model": str(folder / "model"), STAMPED: True}
    managed = {**shared, "imu": "none"}
    return {
        "middleware_node": managed,
        "policy_node": {**managed, "policy": policy, "goal": GOAL, "rate": 0.0},
        "command_gate": {
            **shared,
            "limits": str(limits),
            "black_box": str(folder / "black_box"),
            "stop_when_held": False,  # the room moves with the robot
        },
    }


def _allow_all(robot: RobotSpec) -> dict[str, Any]:
    """Return limits that hardly limit the robot."""
    commands = {}
    for variable in robot.command:
        low = min(variable.min, 0.0)
        high = max(variable.max, 0.0)
        span = high - low
        commands[variable.name] = {
            "min": low,
            "max": high,
            "rate": 2.0 * span,
            "jerk": 40.0 * span,
        }
    return {"robot": robot.name, "commands": commands}


def _wait_until_running(nodes: Sequence[NodeProcess]) -> None:
    def are_running() -> bool:
        for node in nodes:
            node.check()
        return all("running" in node.log.read_text(encoding="utf-8") for node in nodes)

    if not holds(are_running, PATIENCE_S, POLL_S):
        raise BackendError(f"the nodes do not run after {PATIENCE_S:g} s.")


def _measure(
    nodes: Sequence[NodeProcess],
    robot: StandIn,
    cores: float,
    rate: float,
    seconds: float,
) -> Load:
    record = robot.record = Record()
    cpu = _measure_cpu(nodes, seconds)
    robot.record = Record()
    memory_mb = {node.node: read_memory_mb(node.pid) for node in nodes}
    commands = np.array(record.commands)
    to_policy = []
    to_gate = []
    for scan_ns in record.scans:
        if scan_ns in record.answers:
            answer_ns = record.answers[scan_ns]
            to_policy.append(answer_ns - scan_ns)
            to_gate += (commands[commands > answer_ns][:1] - scan_ns).tolist()
    scans = len(record.scans)
    answered = len(to_policy) / max(scans, 1)
    latencies = _summarize(to_policy), _summarize(to_gate)
    return Load(cores, rate, scans, answered, cpu, memory_mb, *latencies)


def _measure_cpu(nodes: Sequence[NodeProcess], seconds: float) -> dict[str, float]:
    """Return the fraction of a core that each node uses during a time [s]."""
    began_s = time.monotonic()
    before_s = {node.node: read_cpu_time(node.pid) for node in nodes}
    time.sleep(seconds)
    for node in nodes:
        node.check()
    lasted_s = time.monotonic() - began_s
    return {
        node.node: (read_cpu_time(node.pid) - before_s[node.node]) / lasted_s
        for node in nodes
    }


def _summarize(delays_ns: Sequence[int]) -> Latency:
    if not delays_ns:
        return Latency(np.nan, np.nan)
    median, p99 = np.quantile(delays_ns, [0.5, 0.99]) * 1e-6
    return Latency(float(median), float(p99))


def read_cpu_time(pid: int) -> float:
    """Return the time that a process has spent on a core [s], user and system."""
    # the name, in parentheses, may contain anything
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_memory_mb(pid: int) -> float:
    """Return the memory of a process and its children [MB]; of shared pages, their part (PSS)."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    kilobytes = 0
    for process in (str(pid), *children):
        with suppress(OSError):  # it has ended
            lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
            kilobytes += next(
                int(line.split()[1]) for line in lines if line.startswith("Pss:")
            )
    return kilobytes * 1024 / 1e6
