"""MujocoRobot: one robot on an endless floor, moved by its motors and by contact alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.highfidelity.library import load_mujoco
from nics_drl_bridge.highfidelity.machine import Machine, Physics
from nics_drl_bridge.highfidelity.machines import build_machine
from nics_drl_bridge.kinematics.spec import RobotSpec
from nics_drl_bridge.kinematics.textbook import textbook

Array = NDArray[np.float64]

SETTLING_S = 0.5
LARGEST_TILT_RAD = 0.5


@dataclass(frozen=True)
class Reading:
    """What is known of a robot at one time.

    Attributes:
        time: since the reset [s].
        pose: (3,) of `base_link`: x [m], y [m], heading [rad].
        twist: (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`.
        state: (S,) by the encoders, in the order of the RobotSpec.
    """

    time: float
    pose: Array
    twist: Array
    state: Array


class MujocoRobot:
    """A robot in MuJoCo.

    Attributes:
        spec: the robot.
        machine: its masses, motors and wheels, as MuJoCo takes them.
        timestep: of MuJoCo [s].
    """

    def __init__(self, spec: RobotSpec, physics: Physics | None = None) -> None:
        """Builds the robot and sets it on the floor.

        Raises:
            ConfigError: MuJoCo is not installed, or the spec lacks what the machine needs.
        """
        self._mujoco = load_mujoco()
        self.spec = spec
        self.machine: Machine = build_machine(spec, physics)
        self._target = textbook(spec).target
        self._model = self._mujoco.MjModel.from_xml_string(self.machine.xml)
        self._data = self._mujoco.MjData(self._model)
        self.timestep = float(self._model.opt.timestep)
        joints = [self._model.joint(name) for name in self.machine.joints]
        self._positions = np.array([int(joint.qposadr[0]) for joint in joints])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in joints])
        self.reset(np.zeros(3))

    def reset(self, pose: ArrayLike) -> Reading:
        """Sets the robot down at a pose (3,), at rest; it has settled when the clock starts."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._advance(SETTLING_S)
        x, y, heading = np.asarray(pose, dtype=np.float64)
        self._data.qpos[:2] = x, y
        self._data.qpos[3:7] = np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)
        self._data.qvel[:] = 0.0
        self._data.time = 0.0
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
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (len(self.spec.command),) or not np.isfinite(command).all():
            raise BackendError(
                f"command {command.tolist()} must be {len(self.spec.command)} finite numbers, as "
                f"robot {self.spec.name!r} takes them."
            )
        wanted = self._target(np.clip(command, self.spec.command_low, self.spec.command_high))
        self._data.ctrl[:] = self.machine.controls(wanted)
        self._advance(duration)
        self._check_upright()
        return self.read()

    def read(self) -> Reading:
        """The reading now."""
        qpos, qvel = self._data.qpos, self._data.qvel
        heading = _heading(qpos[3:7])
        velocity = geometry.rotate(qvel[:2], -heading)
        return Reading(
            time=float(self._data.time),
            pose=np.array([qpos[0], qpos[1], heading]),
            twist=np.array([velocity[0], velocity[1], qvel[5]]),
            state=self.machine.state(qpos[self._positions], qvel[self._speeds]),
        )

    def _advance(self, duration: float) -> None:
        steps = round(duration / self.timestep)
        self._mujoco.mj_step(self._model, self._data, nstep=steps)

    def _check_upright(self) -> None:
        x, y = self._data.qpos[4:6]
        upright = 1.0 - 2.0 * (x * x + y * y)
        if not upright > np.cos(LARGEST_TILT_RAD):
            raise BackendError(
                f"robot {self.spec.name!r} has fallen over at {self._data.time:.2f} s; lower the "
                "acceleration of its Physics, or its command limits."
            )


def _heading(quaternion: Array) -> float:
    """Yaw [rad] of a unit quaternion (4,): w, x, y, z."""
    w, x, y, z = quaternion
    return float(geometry.wrap_angle(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
