"""Rig: one machine within a MuJoCo model.

MujocoRobot: one robot on an infinite floor, moved only by its motors and by contact.

Records a drive of a robot in MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.extras.mujoco.machine import Machine, Physics, load_mujoco
from nics_drl_bridge.extras.mujoco.machines import build_machine
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

LARGEST_TILT_RAD = 0.5


@dataclass(frozen=True)
class Reading:
    """State of a robot at one time.

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


class Rig:
    """Access to one machine in the arrays of a MuJoCo model.

    Args:
        spec: the robot.
        machine: its masses, motors and wheels.
        model: the MuJoCo model that contains the machine.
        prefix: of the names of the machine's parts in it.
        number: number of machines of this kind before it.
    """

    def __init__(
        self, spec: RobotSpec, machine: Machine, model: Any, prefix: str = "", number: int = 0
    ) -> None:
        self.spec, self.machine = spec, machine
        self._target = textbook(spec).target
        base = model.joint(int(model.body(f"{prefix}base_link").jntadr[0]))
        joints = [model.joint(f"{prefix}{name}") for name in machine.joints]
        self._place, self._drift = int(base.qposadr[0]), int(base.dofadr[0])
        self._positions = np.array([int(joint.qposadr[0]) for joint in joints])
        self._speeds = np.array([int(joint.dofadr[0]) for joint in joints])
        count = len(machine.controls(self._target(np.zeros(len(spec.command)))))
        self._controls = slice(number * count, (number + 1) * count)

    def put(self, data: Any, rest: Array, pose: ArrayLike) -> None:
        """Places the robot, at rest.

        Args:
            data: MuJoCo's MjData.
            rest: (nq,) positions of a single machine of this kind at rest on the floor.
            pose: (3,) of `base_link`.
        """
        x, y, heading = np.asarray(pose, dtype=np.float64)
        own = data.qpos[self._place : self._place + len(rest)]
        own[:] = rest
        own[:2] = x, y
        own[3:7] = np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)

    def command(self, data: Any, command: ArrayLike) -> None:
        """Gives the motors a command (C,), clipped to its limits.

        Raises:
            BackendError: the command contains NaN, or has a wrong size.
        """
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (len(self.spec.command),) or not np.isfinite(command).all():
            raise BackendError(
                f"command {command.tolist()} must be {len(self.spec.command)} finite numbers, as "
                f"robot {self.spec.name!r} takes them."
            )
        wanted = self._target(np.clip(command, self.spec.command_low, self.spec.command_high))
        data.ctrl[self._controls] = self.machine.controls(wanted)

    def read(self, data: Any) -> Reading:
        """Returns the current reading."""
        place, velocity = data.qpos[self._place :], data.qvel[self._drift :]
        heading = _heading(place[3:7])
        ahead, aside = geometry.rotate(velocity[:2], -heading)
        return Reading(
            time=float(data.time),
            pose=np.array([place[0], place[1], heading]),
            twist=np.array([ahead, aside, velocity[5]]),
            state=self.machine.state(data.qpos[self._positions], data.qvel[self._speeds]),
        )

    def encoders(self, data: Any) -> Array:
        """(J,) positions of the joints that have encoders [rad]."""
        return np.array(data.qpos[self._positions])

    def mean_state(self, before: Array, after: Array, duration: float) -> Array:
        """Mean state (S,) between two encoder readings (J,), `duration` [s] apart."""
        return self.machine.state(0.5 * (before + after), (after - before) / duration)

    def upright(self, data: Any) -> bool:
        """True while the robot stands on its wheels."""
        x, y = data.qpos[self._place + 4 : self._place + 6]
        return bool(1.0 - 2.0 * (x * x + y * y) > np.cos(LARGEST_TILT_RAD))

    def require_upright(self, data: Any) -> None:
        """Raises BackendError if the robot has fallen over."""
        if not self.upright(data):
            raise BackendError(
                f"robot {self.spec.name!r} has fallen over at {data.time:.2f} s; lower the "
                "acceleration of its Physics, or its command limits."
            )


def _heading(quaternion: Array) -> float:
    """Yaw [rad] of a unit quaternion (4,): w, x, y, z."""
    w, x, y, z = quaternion
    return float(geometry.wrap_angle(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))


SETTLING_S = 0.5


class MujocoRobot:
    """A robot in MuJoCo.

    Attributes:
        spec: the robot.
        machine: its masses, motors and wheels in MuJoCo's form.
        timestep: of MuJoCo [s].
        rest: (nq,) positions in MuJoCo at rest at the origin.
    """

    def __init__(self, spec: RobotSpec, physics: Physics | None = None) -> None:
        """Builds the robot and sets it on the floor.

        Raises:
            ConfigError: MuJoCo is not installed, or the spec lacks a parameter of the machine.
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
        """Places the robot at a pose (3,), at rest and settled, and restarts the clock."""
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
            BackendError: the robot has fallen over, or the command contains NaN.
        """
        self._rig.command(self._data, command)
        self._advance(duration)
        self._rig.require_upright(self._data)
        return self.read()

    def read(self) -> Reading:
        """Returns the current reading."""
        return self._rig.read(self._data)

    def _advance(self, duration: float) -> None:
        steps = round(duration / self.timestep)
        self._mujoco.mj_step(self._model, self._data, nstep=steps)


def record(
    robot: MujocoRobot,
    rng: np.random.Generator,
    duration: float = 60.0,
    dt: float = 0.01,
    hold: float = 0.5,
) -> Recording:
    """Drives at random and records, as `textbook.record` does with the textbook kinematics.

    Args:
        robot: the robot, which is reset to the origin first.
        rng: draws new commands, uniform within their limits, every `hold` seconds.
        duration: of the drive [s].
        dt: sample period, a whole number of the robot's time steps [s].
        hold: duration of a command [s].

    Returns:
        Command, pose and state on one clock.

    Raises:
        BackendError: the robot fell over.
    """
    spec = robot.spec
    per_hold, holds = round(hold / dt), int(np.ceil(duration / hold))
    held = rng.uniform(spec.command_low, spec.command_high, (holds, len(spec.command)))
    commands = np.repeat(held, per_hold, axis=0)
    reading = robot.reset(np.zeros(3))
    poses, states = [], []
    for command in commands:
        poses.append(reading.pose)
        states.append(reading.state)
        reading = robot.step(command, dt)
    t = np.asarray(np.arange(len(commands)) * dt, dtype=np.float64)
    return Recording(
        Stream(t, commands),
        Stream(t, np.array(poses)),
        Stream(t, np.array(states)),
        source=f"MuJoCo {spec.name}",
        variables=spec.variable_names,
    )
