"""One simulated world, as its sensors see it or with other physics for the robots."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.arrays import Array, Integers, Singles
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World, check_inside


@dataclass(frozen=True)
class Sensed:
    """Measurements and true state of one robot at a time."""

    odom: Array  # (3,) pose by odometry
    covariance: Array  # (3, 3) of `odom`
    twist: Array  # (3,) measured body twist
    state: Array  # (S,) true state
    ranges: Singles  # (B,) scan
    pose: Array  # (3,) true pose in `map`
    true_twist: Array  # (3,) mean true body twist over the last step
    readings: Mapping[str, Singles]  # name -> (S,) of each further sensor


class DeviceWorld:
    """Keeps the next command of each of M robots, and the covariance of its odometry."""

    def __init__(
        self, simulator: FastSimulator, model: SimulatorModel, robots: int
    ) -> None:
        self.simulator = simulator
        self._period = model.control_period
        # Completes a drawn scene; returns the robots' starts (1, M, 3), or None.
        self.arrange: Callable[[Scenes, Array | None], Array | None] = (
            lambda _, starts: starts
        )
        self._given = robots
        self._added = step_covariance(model.noise.odometry, self._period)
        self.commands = np.zeros((robots, len(model.robot.command)))
        self._covariance = np.tile(self._added, (robots, 1, 1))
        self._before = simulator.data.pose[0].copy()

    @property
    def robots(self) -> int:
        """M."""
        return len(self.commands)

    @property
    def touched(self) -> list[bool]:
        """For each robot, true if it has touched something in this episode."""
        return [bool(collided) for collided in self.simulator.data.collided[0]]

    def begin(self, seed: int, starts: Array | None) -> None:
        """Begin the episode of a seed, at `starts` (3 M,) x, y, heading if given."""
        robots = self._given
        placed = None
        if starts is not None:
            if starts.size != 3 * robots or not np.isfinite(starts).all():
                raise ConfigError(
                    f"episode_start is {starts.tolist()}; give x, y, heading of each robot: "
                    f"{3 * robots} finite numbers."
                )
            placed = starts.reshape(1, robots, 3)

        def arranged(scenes: Scenes) -> Array | None:
            world = self.simulator.world.members[int(scenes.member[0])]
            for x, y, _ in [] if placed is None else placed[0].tolist():
                check_inside("episode_start", world, x, y)
            return self.arrange(scenes, placed)

        self.simulator.reset([seed], starts=arranged)
        self.commands[:] = 0.0
        self._covariance[:] = self._added
        self._before[:] = self.simulator.data.pose[0]

    def exchange(self, simulator: FastSimulator, kept: Integers) -> None:
        """Continue in another simulator, whose first robots are `kept` here."""
        robots = simulator.data.pose.shape[1]
        commands = np.zeros((robots, self.commands.shape[1]))
        commands[: len(kept)] = self.commands[kept]
        covariance = np.tile(self._added, (robots, 1, 1))
        covariance[: len(kept)] = self._covariance[kept]
        self.simulator = simulator
        self.commands = commands
        self._covariance = covariance
        self._before = simulator.data.pose[0].copy()

    @property
    def world(self) -> World:
        """World of the present episode."""
        return self.simulator.world.members[int(self.simulator.data.member[0])]

    def put(self, robot: int, pose: Array, state: Array) -> None:
        """Put a robot at a pose (3,) in a state (S,), which is not motion."""
        self.simulator.put_robot(robot, pose, state)
        self._before[robot] = self.simulator.data.pose[0, robot]

    def advance(self) -> None:
        """Move all robots by one step."""
        data = self.simulator.data
        self._before[:] = data.pose[0]
        odom = data.odom[0].copy()
        self.simulator.step(self.commands[None])
        data = self.simulator.data
        self._covariance = propagate(self._covariance, odom, data.odom[0], self._added)

    def sensed(self, robot: int) -> Sensed:
        """Return the current values of one robot; the next step may overwrite them."""
        data = self.simulator.data
        moved = geometry.between(self._before[robot], data.pose[0, robot])
        readings = {
            name: values[0, robot] for name, values in self.simulator.readings.items()
        }
        return Sensed(
            data.odom[0, robot],
            self._covariance[robot],
            data.twist[0, robot],
            data.state[0, robot],
            data.ranges[0, robot],
            data.pose[0, robot],
            geometry.log(moved) / self._period,
            readings,
        )


# variance of odometry without noise; in ROS, a covariance of zeros means unknown
LEAST_VARIANCE = 1e-9


def variances(std: tuple[float, float]) -> Array:
    """Variances (3,) of a measured twist, from its linear [m/s] and angular [rad/s] deviation."""
    linear, angular = (max(deviation * deviation, LEAST_VARIANCE) for deviation in std)
    return np.array([linear, linear, angular])


def step_covariance(std: tuple[float, float], period: float) -> Array:
    """Covariance (3, 3) of x, y [m] and heading [rad] that one period [s] adds."""
    return np.diag(np.maximum(variances(std) * period * period, LEAST_VARIANCE))


def propagate(
    covariance: Array, before: ArrayLike, after: ArrayLike, added: Array
) -> Array:
    """Propagate the covariances (M, 3, 3) of poses by odometry (M, 3) from before to after.

    A heading error rotates the motion that follows: P' = F P F^T + Q, where F is the
    Jacobian of the new pose with respect to the old one (Thrun et al., Probabilistic
    Robotics, Sec. 5.4), and Q is `added`.
    """
    moved = np.subtract(after, before)
    derivative = np.tile(np.eye(3), (len(covariance), 1, 1))
    derivative[:, 0, 2] = -moved[:, 1]
    derivative[:, 1, 2] = moved[:, 0]
    return derivative @ covariance @ derivative.transpose(0, 2, 1) + added
