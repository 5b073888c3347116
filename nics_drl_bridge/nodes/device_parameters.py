"""Parameters of a device node: devices, frames, episodes, and the rates of world and topics."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S, Array
from nics_drl_bridge.nodes.parameters import (
    LOCKSTEP,
    MODES,
    find_frame_fault,
    list_rows,
)
from nics_drl_bridge.nodes.runner import declare_rows, get_choice, get_number, get_text
from nics_drl_bridge.pacing import find_common_step
from nics_drl_bridge.robot.noise import Delay
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation


class DeviceTiming(NamedTuple):
    """Timing of a device; lock-step is exact, without any of the delays."""

    mode: str  # one of `MODES`
    rate: float  # simulated seconds per second in realtime
    step_ns: int  # of the world
    odom_ns: int  # between two odometries
    scan_ns: int  # between two scans
    # minimum delay to publication, and maximum additional delay
    scan_late_ns: tuple[int, int]
    odom_late_ns: tuple[int, int]

    @property
    def lockstep(self) -> bool:
        """True if the world waits for commands."""
        return self.mode == LOCKSTEP


class Frames(NamedTuple):
    """Frame ids of one robot, and of the map that all share."""

    map: str
    odom: str
    base: str
    laser: str
    footprint: str  # empty for none
    prefix: str  # of all but the map


def declare_device(node: Node, laser_frame: str) -> None:
    """Declare and check the parameters that all simulators share. Raises ConfigError."""
    (robots,) = list_rows("fleet")
    fleet = ParameterDescriptor(
        description=robots.about, read_only=True, dynamic_typing=True
    )
    node.declare_parameter(robots.name, robots.default, fleet)
    declare_rows(node, "device", "stamped", laser_frame=laser_frame)
    fault = find_frame_fault(node.get_parameters_by_prefix("").values())
    if fault:
        raise ConfigError(fault)


def get_randomisation(node: Node) -> Randomisation | None:
    """Return the randomisation of each episode, if any. Raises ConfigError."""
    name = get_text(node, "randomisation")
    return load_randomisation(name) if name else None


def get_timing(node: Node, model: SimulatorModel) -> DeviceTiming:
    """Return the timing given by the parameters; in lock-step, by the model alone."""
    mode = get_choice(node, "mode", MODES)
    if mode == LOCKSTEP:
        period = round(model.control_period * NS_PER_S)
        return DeviceTiming(mode, 1.0, period, period, period, (0, 0), (0, 0))
    rate = get_number(node, "odom_rate")
    dt = model.timing.dt
    odom = 1.0 / rate if rate else model.control_period
    scan = 1.0 / (get_number(node, "scan_rate") or model.lidar.rate)
    step = find_common_step(dt, (odom, scan)) * dt
    step_ns, odom_ns, scan_ns = (
        round(seconds * NS_PER_S) for seconds in (step, odom, scan)
    )
    return DeviceTiming(
        mode,
        get_number(node, "rate"),
        step_ns,
        odom_ns,
        scan_ns,
        scan_late_ns=_get_delay(node, model, "scan"),
        odom_late_ns=_get_delay(node, model, "odom"),
    )


def _get_delay(node: Node, model: SimulatorModel, topic: str) -> tuple[int, int]:
    """Return the minimum delay of a topic and the maximum additional one [ns]."""
    delay = model.latency.measured.get(topic, Delay(least=0.0, jitter=0.0))
    least = get_number(node, f"{topic}_latency")
    jitter = get_number(node, "latency_jitter")
    if least < 0.0:
        least = delay.least
    if jitter < 0.0:
        jitter = delay.jitter
    return round(least * NS_PER_S), round(jitter * NS_PER_S)


def apply_timing(
    node: Node, model: SimulatorModel, time: DeviceTiming
) -> SimulatorModel:
    """Return the model with the step of the world and the requested latency."""
    if time.lockstep:
        return model
    latency = get_number(node, "command_latency")
    if latency >= 0.0:
        model = replace(
            model, calibration=replace(model.calibration, command_latency_s=latency)
        )
    dt = model.timing.dt
    steps = round(time.step_ns / NS_PER_S / dt)
    if steps == model.timing.substeps:
        return model
    return replace(model, control_period=steps * dt)


def get_frames(node: Node, namespace: str) -> Frames:
    """Return the frames of a robot; in a fleet all but the map begin with its namespace."""
    prefix = get_text(node, "frame_prefix") + (f"{namespace}/" if namespace else "")
    world, *names = (get_text(node, f"{frame}_frame") for frame in Frames._fields[:-1])
    odom, base, laser, footprint = (name and prefix + name for name in names)
    return Frames(world, odom, base, laser, footprint, prefix)


def get_episode_start(node: Node) -> Array | None:
    """Return x, y, heading of each robot (3 M,) for the next episode; None: by its seed."""
    start = np.array(node.get_parameter("episode_start").value, dtype=np.float64)
    return None if np.isnan(start).all() else start
