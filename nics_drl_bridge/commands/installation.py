"""Checks of this machine: Python, ROS 2, extras, cores, compiled kernels."""

import os
import sys
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, metadata, version
from importlib.util import find_spec
from typing import NamedTuple

from nics_drl_bridge.extensions import (
    INSTALL_ROS,
    PACKAGE,
    SB3,
    TRAINING,
    find_lacking,
)
from nics_drl_bridge.nodes.message_packages import explain_install

EXTRAS = {  # extra -> purpose, modules that it installs
    "bags": ("reading and writing rosbags", ("rosbags", "mcap")),
    "deploy": ("driving by policy files", ("onnx", "onnxruntime")),
    "train": ("training", TRAINING),
    "sb3": ("training with Stable-Baselines3", SB3),
    "multi": ("teams, as PettingZoo environments", ("pettingzoo",)),
    "view": ("the page of nics watch", ("websockets",)),
    "video": ("MP4 files of nics watch", ("imageio_ffmpeg",)),
    "mujoco": ("robots with real wheels, in MuJoCo", ("mujoco",)),
    "dart": ("robots with real wheels, in DART", ("dartpy",)),
    "distributed": ("training on a Ray cluster", ("ray",)),
}
MESSAGES = {  # message package without a wheel -> what does not work without it
    "tf2_msgs": "/tf and /tf_static",
    "ackermann_msgs": "recordings of AckermannDrive",
    "simulation_interfaces": "the standard services of simulators",
}
COMPILED = (
    "env.vector_env",
    "env.bridge_env",
    "policy.policies",
    "gate.shield",
    "middleware.ekf",
)


class Check(NamedTuple):
    """Result of the check of one part of an installation."""

    part: str
    works: bool
    found: str
    fix: str = ""


def checks() -> list[Check]:
    """Checks all parts without compiling or starting anything."""
    usable = os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        usable = len(os.sched_getaffinity(0))
    cores = Check(
        "cores", (usable or 1) > 1, f"{usable} of {os.cpu_count()} may be used", ""
    )
    for name in COMPILED:
        import_module(f"{PACKAGE}.{name}")
    from nics_drl_bridge.kernels import KERNELS, SECONDS_EACH

    cold = sum(not kernel.is_warm for kernel in KERNELS)
    text = f"{len(KERNELS) - cold} of {len(KERNELS)} are compiled"
    seconds = max(1, round(cold * SECONDS_EACH))
    fix = (
        f"nics warmup --all, about {seconds} s; else each is compiled at its first use"
    )
    kernels = Check("kernels", cold == 0, text, fix)
    return [_check_python(), *_check_extras(), *_check_ros(), cores, kernels]


def _check_python() -> Check:
    needed = ">=3.10,<3.15"
    with suppress(PackageNotFoundError):  # a source tree that was never installed
        needed = metadata(PACKAGE)["Requires-Python"] or needed
    parts = sorted(
        needed.replace(" ", "").split(","), key=lambda part: not part.startswith(">=")
    )
    low, high = (
        tuple(map(int, part.lstrip("<>=").split(".")[:2])) for part in parts[:2]
    )
    works = low <= sys.version_info[:2] < high
    running = ".".join(map(str, sys.version_info[:3]))
    return Check("Python", works, running, f"use a Python {needed}")


def _check_extras() -> list[Check]:
    results = []
    for extra, (what, modules) in EXTRAS.items():
        missing = find_lacking(modules)
        text = what if missing is None else f"{what}: the module {missing!r} is missing"
        fix = f"pip install '{PACKAGE}[{extra}]'"
        results.append(Check(f"extra {extra}", missing is None, text, fix))
    return results


def _check_ros() -> list[Check]:
    if find_spec("rclpy") is None:
        text = "driving over topics: none is sourced or installed"
        return [Check("ROS 2", False, text, INSTALL_ROS)]
    try:
        release = version("rclpy")
    except PackageNotFoundError:
        release = "of unknown version"
    distribution = os.environ.get("ROS_DISTRO") or "from wheels"
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    text = f"{distribution}, rclpy {release}, ROS_DOMAIN_ID {domain}"
    messages = [
        Check(name, find_spec(name) is not None, purpose, explain_install(name))
        for name, purpose in MESSAGES.items()
    ]
    return [Check("ROS 2", True, text), *messages]
