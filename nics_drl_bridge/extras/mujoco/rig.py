"""One machine within a MuJoCo model, a robot on an infinite floor, and a recorded drive of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.extras.mujoco.machines import Machine, Physics, build_machine, load_mujoco
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec

Array = NDArray[np.float64]

LARGEST_TILT_RAD = 0.5
SETTLING_S = 0.5


@dataclass(frozen=True)
class Reading:
    """State of a robot at one time."""

    time: float  # since the reset [s]
    pose: Array  # (3,) of `base_link`: x [m], y [m], heading [rad]
    twist: Array  # (3,) vx [m/s], vy [m/s], wz [rad/s] in `base_link`
    state: Array  # (S,) by the encoders, in the order of the RobotSpec


class Rig:
    """Access to one machine in the arrays of a MuJoCo model.

    `prefix` is that of the names of its parts, `number` that of machines of its kind before it.
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
        """Places the robot at a pose (3,), with its parts as at rest (nq,) on the floor."""
        x, y, heading = np.asarray(pose, dtype=np.float64)
        own = data.qpos[self._place : self._place + len(rest)]
        own[:] = rest
        own[:2] = x, y
        own[3:7] = np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading)

    def command(self, data: Any, command: ArrayLike) -> None:
        """Gives the motors a command (C,), clipped to its limits. Raises BackendError for NaN."""
        command, count = np.asarray(command, dtype=np.float64), len(self.spec.command)
        if command.shape != (count,) or not np.isfinite(command).all():
            reason = f"must be {count} finite numbers, as robot {self.spec.name!r} takes them."
            raise BackendError(f"command {command.tolist()} {reason}")
        wanted = self._target(np.clip(command, self.spec.command_low, self.spec.command_high))
        data.ctrl[self._controls] = self.machine.controls(wanted)

    def read(self, data: Any) -> Reading:
        """Returns the current reading."""
        place, velocity = data.qpos[self._place :], data.qvel[self._drift :]
        w, x, y, z = place[3:7]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        heading = float(geometry.wrap_angle(yaw))
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

    def require_upright(self, data: Any) -> None:
        """Raises BackendError if the robot has fallen over."""
        x, y = data.qpos[self._place + 4 : self._place + 6]
        if not 1.0 - 2.0 * (x * x + y * y) > np.cos(LARGEST_TILT_RAD):
            raise BackendError(
                f"robot {self.spec.name!r} has fallen over at {data.time:.2f} s; lower the "
                "acceleration of its Physics, or its command limits."
            )


class MujocoRobot:
    """A robot on an infinite floor, moved only by its motors and by contact.

    Attributes:
        rest: (nq,) positions in MuJoCo at rest at the origin.

    Raises:
        ConfigError: MuJoCo is not installed, or the spec lacks a parameter of the machine.
    """

    def __init__(self, spec: RobotSpec, physics: Physics | None = None) -> None:
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
        """Drives with a command (C,), clipped to its limits, for a whole number of time steps [s].

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

    The robot is reset to the origin first. New commands are drawn, uniform within their limits,
    every `hold` seconds; the sample period `dt` [s] is a whole number of the robot's time steps.

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
