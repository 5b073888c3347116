"""The physics engines under test: how each is built, and how close it comes."""

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import pytest

from nics_drl_bridge.extras.physics.machines import Physics


@dataclass(frozen=True)
class Engine:
    """An engine of `nics_drl_bridge.extras`."""

    name: str
    library: str  # its Python module
    rest_error: float  # of a robot that stands for a second [m, rad]
    encoder_error: float  # of a pose by encoders after two seconds [m, rad]
    skid_error: float  # of the turn rate of wheels that skid, relative
    slip_error: float  # of a motion without slip beside the model's, relative
    wall_error: float  # of where a wall stops a robot [m]

    def find(self, kind: str) -> Any:
        """`Robot` or `Simulator` of the engine."""
        module = import_module(f"nics_drl_bridge.extras.{self.name.lower()}.simulator")
        return getattr(module, kind)

    @property
    def physics(self) -> Physics:
        return self.find("PHYSICS")

    def robot(self, *given: Any, **named: Any) -> Any:
        return self.find(f"{self.name.capitalize()}Robot")(*given, **named)

    def simulator(self, *given: Any, **named: Any) -> Any:
        return self.find(f"{self.name.capitalize()}Simulator")(*given, **named)


ENGINES = (
    Engine(
        name="DART",
        library="dartpy",
        rest_error=3e-3,
        encoder_error=0.02,
        skid_error=0.1,
        slip_error=0.07,
        wall_error=0.015,
    ),
    Engine(
        name="MuJoCo",
        library="mujoco",
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
        skip = pytest.mark.skipif(missing, reason=f"needs {engine.name}")
        rows.append(pytest.param(engine, marks=skip, id=engine.name))
    return rows
