"""The physics engines under test: how each is built, and how close it comes."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import pytest

from nics_drl_bridge.extras.dart.scenery import load_dart
from nics_drl_bridge.extras.dart.simulator import PHYSICS, DartRobot, DartSimulator
from nics_drl_bridge.extras.mujoco.machines import load_mujoco
from nics_drl_bridge.extras.mujoco.simulator import MujocoRobot, MujocoSimulator
from nics_drl_bridge.extras.physics.machines import Physics


@dataclass(frozen=True)
class Engine:
    """An engine of `nics_drl_bridge.extras`."""

    name: str
    extra: str  # that installs it
    library: str  # its Python module
    load: Callable[[], Any]  # returns the library, or says what to install
    robot: Callable[..., Any]  # a PhysicsRobot of a spec
    simulator: Callable[..., Any]  # a PhysicsSimulator of a model and a world
    physics: Physics
    rest_error: float  # of a robot that stands for a second [m, rad]
    encoder_error: float  # of a pose by encoders after two seconds [m, rad]
    skid_error: float  # of the turn rate of wheels that skid, relative
    slip_error: float  # of a motion without slip beside the model's, relative
    wall_error: float  # of where a wall stops a robot [m]


ENGINES = (
    Engine(
        name="DART",
        extra="dart",
        library="dartpy",
        load=load_dart,
        robot=DartRobot,
        simulator=DartSimulator,
        physics=PHYSICS,
        rest_error=3e-3,
        encoder_error=0.02,
        skid_error=0.1,
        slip_error=0.07,
        wall_error=0.015,
    ),
    Engine(
        name="MuJoCo",
        extra="mujoco",
        library="mujoco",
        load=load_mujoco,
        robot=MujocoRobot,
        simulator=MujocoSimulator,
        physics=Physics(),
        rest_error=2e-3,
        encoder_error=0.01,
        skid_error=0.04,
        slip_error=0.05,
        wall_error=0.01,
    ),
)


def list_rows() -> list[Any]:
    """A parameter per engine, which skips where its library is missing."""
    rows = []
    for engine in ENGINES:
        missing = find_spec(engine.library) is None
        reason = f"needs {engine.name}: the extra `{engine.extra}`"
        skip = pytest.mark.skipif(missing, reason=reason)
        rows.append(pytest.param(engine, marks=skip, id=engine.name))
    return rows
