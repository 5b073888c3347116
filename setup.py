"""Packaging for pip and for colcon (build type ament_python)."""

import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "nics_drl_bridge"
SHARE = f"share/{PACKAGE}"
ROOT = Path(__file__).resolve().parent

MANIFEST = ElementTree.parse(ROOT / "package.xml")

REQUIRES = [
    "filterpy>=2.0",
    "gymnasium>=1.2,<1.5",
    "matplotlib>=3.8",
    "numba>=0.60,<0.70",  # kernels.py derives from its compiler
    "numpy>=1.26",
    "pillow>=10.1",
    "pydantic>=2.6",
    "pyyaml>=6.0",
    "rich>=13",
    "scipy>=1.11",
    "threadpoolctl>=3.1",
    "typer>=0.19",
]
# ROS 2 from wheels, for a machine without a ROS 2 installation. Never install `lark` beside
# them: it overwrites `lark-parser`, which they need.
ROS_WHEELS_EXIST = "platform_system == 'Linux' and platform_machine == 'x86_64'"
EXTRAS = {
    "ros": [
        f"{wheel}; {ROS_WHEELS_EXIST}"
        for wheel in ("ros-rclpy", "ros-common-interfaces", "ros-rmw-fastrtps-cpp")
    ],
    "bags": ["mcap>=1.3,<2", "rosbags>=0.11,<0.12"],
    "mujoco": ["mujoco>=3.3"],
    "dart": [
        f"dartpy>=6.20; {ROS_WHEELS_EXIST}"
    ],  # it has wheels for this platform only
    "multi": ["pettingzoo>=1.25,<1.28"],
    "train": [
        "filelock>=3.12",
        "onnx>=1.16",
        "onnxruntime>=1.18",  # a policy file is checked by it as it is written
        "tensorboard>=2.16",
    ],
    # Of torch's releases for Linux only some are small, as 2.13 is: no CUDA packages.
    "sb3": [
        "onnxscript>=0.1",
        "stable-baselines3>=2.7,<2.10",
        "torch>=2.6,<2.14",
    ],
    # RLlib holds Gymnasium at a version of its own: for an environment apart, as `nox -s ray`
    # builds one, and no part of `dev`.
    "distributed": ["ray[rllib]>=2.60,<2.61"],
    "deploy": ["onnx>=1.16", "onnxruntime>=1.18", "safetensors>=0.4"],
    # Isaac's runner of policy bundles, which the tests hold ours against; reading and writing them
    # needs `deploy` alone. A library of its pictures has wheels for this platform only.
    "leapp": [f"leapp>=0.7.2; {ROS_WHEELS_EXIST}"],
    "view": ["websockets>=14"],
    "video": ["imageio-ffmpeg>=0.5"],
    # The site of docs/, and what runs and shows its notebooks.
    "docs": [
        "ipykernel>=6.29",
        "latex2mathml>=3.77",  # formulas without scripts
        "mkdocs-material>=9.6,<10",
        "mkdocstrings[python]>=0.29",
        "nbconvert>=7.16",
    ],
    "test": [
        "build",
        "colcon-bash",
        "colcon-package-selection",
        "colcon-ros",
        "dockerfile-parse",
        "flake8",
        "hypothesis",
        # what others fit to a drive: MuJoCo's own identification, and SINDy
        "mujoco[sysid]>=4; python_version >= '3.11'",
        "mypy",
        "nox",
        "pre-commit",
        "pyarrow",
        "pysindy>=2.1,<2.2",
        "pytest",
        "pytest-timeout",
        "pytest-xdist",
        "ruff",
        "setuptools",
        "shapely",
        "types-PyYAML",
        "uv",  # the Makefile installs with it
    ],
}
# All that a user may want. ROS 2 comes from a ROS 2 installation, or from `ros` beside this.
EXTRAS["all"] = [
    one
    for name in (
        "bags",
        "dart",
        "deploy",
        "mujoco",
        "multi",
        "sb3",
        "train",
        "video",
        "view",
    )
    for one in EXTRAS[name]
]
# What `make setup` installs: where a ROS 2 is sourced, and where none is.
APART = ("ros", "distributed", "all")
EXTRAS["dev-without-ros"] = [
    one for name in EXTRAS if name not in APART for one in EXTRAS[name]
]
EXTRAS["dev"] = EXTRAS["dev-without-ros"] + EXTRAS["ros"]


def text_of(tag: str) -> str:
    """The text of a tag of package.xml, on one line."""
    text = MANIFEST.findtext(tag)
    if text is None:
        raise ValueError(f"package.xml: the tag <{tag}> is missing; add it.")
    return " ".join(text.split())


def data_files() -> list[tuple[str, list[str]]]:
    """What goes to share/: the ament index marker, package.xml, config, launch files, URDF."""
    by_folder = {
        "share/ament_index/resource_index/packages": [f"resource/{PACKAGE}"],
        SHARE: ["package.xml"],
    }
    if not {"bdist_wheel", "editable_wheel"} & set(
        sys.argv
    ):  # pip makes one of its own
        by_folder["bin"] = ["resource/bin/nics"]
    for top in ("config", "launch", "urdf"):
        for path in sorted((ROOT / top).rglob("*")):
            file = path.relative_to(ROOT)
            if path.is_file() and "__pycache__" not in file.parts:
                by_folder.setdefault(f"{SHARE}/{file.parent.as_posix()}", []).append(
                    str(file)
                )
    return list(by_folder.items())


setup(
    name=PACKAGE,
    version=text_of("version"),
    description=text_of("description"),
    maintainer=text_of("maintainer"),
    maintainer_email=MANIFEST.find("maintainer").get("email"),
    license=text_of("license"),
    python_requires=">=3.10,<3.15",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={
        # `make wheel` writes the machine code.
        PACKAGE: [
            "py.typed",
            "nodes/*.xml",
            "nodes/*.yaml",
            "watch/*.html",
            "machine_code/*",
        ]
    },
    data_files=data_files(),
    zip_safe=False,
    install_requires=REQUIRES,
    extras_require=EXTRAS,
    entry_points={
        "console_scripts": [
            f"nics = {PACKAGE}.commands.start:main",
            f"simulator_node = {PACKAGE}.nodes.start:simulator_node",
            f"mujoco_node = {PACKAGE}.nodes.start:mujoco_node",
            f"dart_node = {PACKAGE}.nodes.start:dart_node",
            f"middleware_node = {PACKAGE}.nodes.start:middleware_node",
            f"policy_node = {PACKAGE}.nodes.start:policy_node",
            f"command_gate = {PACKAGE}.nodes.start:command_gate",
            f"record_node = {PACKAGE}.nodes.start:record_node",
        ],
        # For tools that list environments; gymnasium itself stopped reading this in 1.0.
        "gymnasium.envs": [f"NicsBridge = {PACKAGE}.env.registry:register_envs"],
        f"{PACKAGE}.adapters": [
            f"foreign = {PACKAGE}.extras.foreign_policies",
            f"torch = {PACKAGE}.extras.sb3.export",
        ],
        f"{PACKAGE}.backends": [
            f"sim = {PACKAGE}.env.sim_backend:SimBackend",
            f"dds = {PACKAGE}.nodes.backends:dds_backend",
            f"ros = {PACKAGE}.nodes.backends:dds_backend",
        ],
        f"{PACKAGE}.commands": [f"bag = {PACKAGE}.extras.bags.command:bag"],
        f"{PACKAGE}.engines": [f"ray = {PACKAGE}.extras.ray.engine:learner"],
        f"{PACKAGE}.node_parts": [
            f"device.simulation_interfaces = {PACKAGE}.extras.simulation_interfaces:open_services",
            f"policy.nav2 = {PACKAGE}.extras.nav2.follow_path:PathActions",
        ],
        f"{PACKAGE}.nodes": [
            f"dart_node = {PACKAGE}.extras.dart.node:main",
            f"mujoco_node = {PACKAGE}.extras.mujoco.node:main",
        ],
        f"{PACKAGE}.sensors": [f"lidar = {PACKAGE}.lidar.further_lidar:FurtherLidar"],
        f"{PACKAGE}.trainings": [f"sb3 = {PACKAGE}.extras.sb3.training:Sb3Training"],
        f"{PACKAGE}.viewers": [f"human = {PACKAGE}.watch.human:HumanView"],
    },
)
