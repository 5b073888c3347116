"""The backends that an env drives: those by name, and a user's own."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import MISSING_ROS, ConfigError, nearest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import Backend, RobotView, Start
from nics_drl_bridge.sim.world import World

BACKENDS = {
    "sim": "nics_drl_bridge.env.sim_backend:SimBackend",
    "dds": "nics_drl_bridge.nodes.backends:dds_backend",
}
"""Where each backend lives. Named as text, so that an env in process never imports ROS 2."""
NEEDED = ("reset", "step", "close")


class HaltedByStep:
    """A backend that has no `halt`: a step with the command nearest to zero takes its place.

    Args:
        backend: with `reset`, `step` and `close`.
        still: (C,), or (M, C) of a team, the command.
    """

    def __init__(self, backend: Any, still: NDArray[np.float64]) -> None:
        self._backend, self._still = backend, still
        self._told = False

    def reset(self, start: Start) -> RobotView:
        """That of the backend."""
        view: RobotView = self._backend.reset(start)
        return view

    def step(self, command: NDArray[np.float64]) -> tuple[RobotView, dict[str, Any]]:
        """That of the backend."""
        self._told = True
        told: tuple[RobotView, dict[str, Any]] = self._backend.step(command)
        return told

    def halt(self) -> None:
        """Steps once with the command nearest to zero, where another one came before."""
        if self._told:
            self._backend.step(self._still.copy())
            self._told = False

    def close(self) -> None:
        """That of the backend, which leaves a zero behind by itself."""
        self._backend.close()
        self._told = False


def halting(backend: Any, still: NDArray[np.float64]) -> Backend:
    """A user's own backend as one that can be halted.

    Raises:
        ConfigError: it is no backend.
    """
    if isinstance(backend, Backend):
        return backend
    missing = [name for name in NEEDED if not callable(getattr(backend, name, None))]
    if missing:
        raise ConfigError(
            f"backend of type {type(backend).__name__}: has no {', no '.join(missing)}; see "
            "interface.Backend."
        )
    return HaltedByStep(backend, still)


def make_backend(name: str, model: SimulatorModel, world: World, **options: Any) -> Backend:
    """A backend by name.

    Raises:
        ConfigError: unknown name, or its library is missing.
    """
    if name not in BACKENDS:
        raise ConfigError(f"unknown backend {name!r}; {nearest(name, BACKENDS)}")
    module, _, factory = BACKENDS[name].partition(":")
    try:
        made: Backend = getattr(import_module(module), factory)(model, world, **options)
    except ModuleNotFoundError as error:
        raise ConfigError(f"backend {name!r} {MISSING_ROS.format(module=error.name)}") from None
    return made
