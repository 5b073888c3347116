"""MujocoRobot: one robot on an endless floor, moved by its motors and by contact alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.highfidelity.library import load_mujoco
from nics_drl_bridge.highfidelity.machine import Machine, Physics
from nics_drl_bridge.highfidelity.machines import build_machine
from nics_drl_bridge.highfidelity.rig import Reading, Rig
from nics_drl_bridge.kinematics.spec import RobotSpec

Array = NDArray[np.float64]

SETTLING_S = 0.5


class MujocoRobot:
    """A robot in MuJoCo.

    Attributes:
        spec: the robot.
        machine: its masses, motors and wheels, as MuJoCo takes them.
        timestep: of MuJoCo [s].
        rest: (nq,) positions in MuJoCo when it stands at the origin.
    """

    def __init__(self, spec: RobotSpec, physics: Physics | None = None) -> None:
        """Builds the robot and sets it on the floor.

        Raises:
            ConfigError: MuJoCo is not installed, or the spec lacks what the machine needs.
        """
        self._mujoco = load_mujoco()
        self.spec = spec
        self.machine: Machine = build_machine(spec, physics)
        self._model = self._mujoco.MjModel.from_xml_string(self.machine.xml)
        self._data = self._mujoco.MjData(self._model)
        self._rig = Rig(spec, self.machine, self._model)
        self.timestep = float(self._model.opt.timestep)
        self._advance(SETTLING_S)
        self.rest = self._data.qpos.copy()
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> Reading:
        """Sets the robot down at a pose (3,), at rest; it has settled when the clock starts."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._rig.put(self._data, self.rest, pose)
        self._mujoco.mj_forward(self._model, self._data)
        return self.read()

    def step(self, command: ArrayLike, duration: float) -> Reading:
        """Drives with a constant command.

        Args:
            command: (C,) in the order of the RobotSpec; clipped to its limits.
            duration: a whole number of time steps [s].

        Returns:
            The reading at the end.

        Raises:
            BackendError: the robot has fallen over, or the command holds NaN.
        """
        self._rig.command(self._data, command)
        self._advance(duration)
        self._rig.require_upright(self._data)
        return self.read()

    def read(self) -> Reading:
        """The reading now."""
        return self._rig.read(self._data)

    def _advance(self, duration: float) -> None:
        steps = round(duration / self.timestep)
        self._mujoco.mj_step(self._model, self._data, nstep=steps)
