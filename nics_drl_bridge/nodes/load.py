"""CPU, memory and scan-to-command latency of a vehicle's nodes on this machine.

Middleware, policy and gate run as processes in a ROS domain of their own, where no robot receives
their commands. A stand-in robot publishes scans and odometry at fixed rates, and follows `cmd_vel`.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.generator import SimulatorModel, save_model
from nics_drl_bridge.nodes.faulty_robot import Robot
from nics_drl_bridge.nodes.listener import holds
from nics_drl_bridge.nodes.parameters import STAMPED
from nics_drl_bridge.nodes.processes import NodeProcess, unused_domain_id
from nics_drl_bridge.robot.spec import RobotSpec

CORES = (1.0, 0.5, 0.25)
RATES = (10.0, 20.0)
SECONDS = 6.0
PATIENCE_S = 600.0  # kernels may have to be compiled
ARMING_S = 20.0
CONTROL_GROUPS = Path("/sys/fs/cgroup")
PERIOD_US = 100_000  # the kernel's own, which containers and systemd use too
CLOSING_S = 2.0
SETTLE_S = 0.5  # after a change of rate or share
POLL_S = 0.02
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


class CoreShare(AbstractContextManager["CoreShare", None]):
    """A control group with priority over other programs, up to its share of a core.

    Raises OSError if this user must not create one.
    """

    def __init__(self, root: Path = CONTROL_GROUPS) -> None:
        controllers = root / "cgroup.controllers"
        self._is_v2 = controllers.is_file()
        if self._is_v2:
            (root / "cgroup.subtree_control").write_text("+cpu", encoding="ascii")
        parent = root if self._is_v2 else root / "cpu"
        self._folder = parent / f"nics_drl_bridge_{os.getpid()}"
        self._folder.mkdir()
        if self._is_v2:
            self._write("cpu.weight", 10_000)
        else:
            self._write("cpu.shares", 262_144)

    def add(self, pid: int) -> None:
        """Move a process into the group; its future children follow."""
        self._write("cgroup.procs", pid)

    def limit(self, cores: float) -> None:
        """Limit all processes together to a fraction of a core."""
        quota_us = round(cores * PERIOD_US)
        if self._is_v2:
            self._write("cpu.max", f"{quota_us} {PERIOD_US}")
        else:
            self._write("cpu.cfs_period_us", PERIOD_US)
            self._write("cpu.cfs_quota_us", quota_us)

    def _write(self, name: str, value: object) -> None:
        (self._folder / name).write_text(str(value), encoding="ascii")

    def __exit__(self, *_: object) -> None:
        if not holds(self._is_removed, CLOSING_S, POLL_S):
            self._folder.rmdir()  # says why not

    def _is_removed(self) -> bool:
        with suppress(OSError):  # a process has not ended yet
            self._folder.rmdir()
        return not self._folder.exists()


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
            robot.arm(ARMING_S)
            robot.set_rate(rate)
            if group is not None:
                group.limit(share)
            robot.until(lambda: False, SETTLE_S)
            loads.append(_measure(nodes, robot, share, rate, seconds))
    return loads, unlimited


@contextmanager
def _run_nodes(
    model: SimulatorModel, policy: str, group: CoreShare | None
) -> Iterator[tuple[list[NodeProcess], Robot]]:
    """Run the nodes on one core, and a robot on the others if there are any."""
    domain_id = unused_domain_id()
    all_cores = os.sched_getaffinity(0)
    core = max(all_cores)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        save_model(model, folder / "model")  # a vehicle has its model in a folder, too
        limits = folder / "limits.yaml"
        _write_limits(model.robot, limits)
        parameters: dict[str, dict[str, Any]] = {
            "middleware_node": {"imu": "none"},
            "policy_node": {"imu": "none", "policy": policy, "goal": GOAL, "rate": 0.0},
            "command_gate": {
                "limits": str(limits),
                "black_box": str(folder / "black_box"),
                "stop_when_held": False,  # the robot's scans do not show how it moves
            },
        }
        stack.callback(os.sched_setaffinity, 0, all_cores)
        os.sched_setaffinity(0, {core})  # of this thread, and of what it starts
        nodes = []
        for name, values in parameters.items():
            values |= {"model": str(folder / "model"), STAMPED: False}
            process = NodeProcess(name, folder, values, domain_id)
            nodes.append(stack.enter_context(process))
            if group is not None:
                group.add(process.pid)
        os.sched_setaffinity(0, all_cores - {core} or all_cores)
        robot = Robot(
            domain_id, model, np.zeros(3), policy=True, odom_hz=model.lidar.rate
        )
        stack.callback(robot.close)
        # the middleware has an estimate of its own
        robot.silent.add("odometry/filtered")

        def are_running() -> bool:
            for node in nodes:
                node.check()
            return all(
                "running" in node.log.read_text(encoding="utf-8") for node in nodes
            )

        if not robot.until(are_running, PATIENCE_S):
            raise BackendError(f"the nodes do not run after {PATIENCE_S:g} s.")
        yield nodes, robot


def _write_limits(robot: RobotSpec, file: Path) -> None:
    """Write limits that hardly limit a robot."""
    commands = {}
    for variable in robot.command:
        low = min(variable.min, 0.0)
        high = max(variable.max, 0.0)
        slopes = {"rate": 2.0 * (high - low), "jerk": 40.0 * (high - low)}
        commands[variable.name] = {"min": low, "max": high, **slopes}
    text = dump_yaml({"robot": robot.name, "commands": commands})
    file.write_text(text, encoding="utf-8")


def _measure(
    nodes: Sequence[NodeProcess],
    robot: Robot,
    cores: float,
    rate: float,
    seconds: float,
) -> Load:
    robot.scans_ns.clear()
    robot.heard.clear()
    began_s = time.monotonic()
    before_s = [read_cpu_time(node.pid) for node in nodes]
    robot.until(lambda: False, seconds)
    cpu = {}
    for node, node_before_s in zip(nodes, before_s, strict=True):
        node.check()
        spent_s = read_cpu_time(node.pid) - node_before_s
        cpu[node.node] = spent_s / (time.monotonic() - began_s)
    memory_mb = {node.node: read_memory_mb(node.pid) for node in nodes}
    commands_ns = np.array([robot.to_system_ns(when) for when, _ in robot.heard])
    to_policy = []
    to_gate = []
    for scan_ns in robot.scans_ns:
        if scan_ns in robot.answers_ns:
            answer_ns = robot.answers_ns[scan_ns]
            to_policy.append(answer_ns - scan_ns)
            to_gate += (commands_ns[commands_ns > answer_ns][:1] - scan_ns).tolist()
    scans = len(robot.scans_ns)
    answered = len(to_policy) / max(scans, 1)
    latencies = _summarize(to_policy), _summarize(to_gate)
    return Load(cores, rate, scans, answered, cpu, memory_mb, *latencies)


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
