"""Mirror: what a robot sees and does with left and right exchanged, for a training."""

from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env.task import Mirror, Sight, Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array, wrap_angle
from nics_drl_bridge.robot.kinds import has_textbook, steady_twist
from nics_drl_bridge.robot.spec import RobotSpec

Places = NDArray[np.intp]
SIGNS = np.array([1.0, -1.0, -1.0])  # of vx, vy and wz in a mirror
MOST_SEARCHED = 4  # commands that can be searched
TRIED = 8  # twists that have to agree
# by which a scan may be off its mirror image: angles are float32
NEAR_RAD = 1e-4
NEAR_M = 1e-6


def mirror_of(task: Task, signs: ArrayLike) -> Mirror:
    """The mirror of a task that observes its scan, then parts with these signs, see `Task.box`.

    Raises ConfigError where robot, scan or parts are not symmetric about the x axis of `base_link`.
    """
    name = type(task).__name__
    if task.sensors:
        fault = f"of the sensor {task.sensors[0].name!r} no mirror image is known"
        raise ConfigError(f"{fault}; leave out ppo.mirror, or the sensor.")
    scan = _mirrored_scan(task.sight)
    parts = np.asarray(signs, np.float64)
    places = np.concatenate([scan, len(scan) + np.arange(len(parts))])
    factors = np.concatenate([np.ones(len(scan)), parts])
    space = task.observation_space
    if places.shape != space.shape:
        fault = (
            f"mirrors {len(places)} parts of an observation, which has {space.shape[0]}"
        )
        raise ConfigError(
            f"task {name}: {fault}; give a sign to each that follows the scan."
        )
    ends = np.stack([factors * space.low[places], factors * space.high[places]])
    wrong = (ends.min(axis=0) != space.low) | (ends.max(axis=0) != space.high)
    if wrong.any():
        k = int(np.argmax(wrong))
        fault = f"part {k} lies from {space.low[k]:g} to {space.high[k]:g}, its mirror image not"
        raise ConfigError(f"task {name}: {fault}; correct its sign, or its limits.")
    return Mirror(places, factors, *_mirrored_actions(task))


def _mirrored_scan(sight: Sight) -> Places:
    """Places (P,) of the parts that look to the other side."""
    apart = np.abs(wrap_angle(sight.angles + sight.angles[0]))
    places = (int(np.argmin(apart)) - np.arange(len(apart))) % len(apart)
    off = np.abs(wrap_angle(sight.angles + sight.angles[places]))
    if off.max() > NEAR_RAD or abs(float(sight.origin[1])) > NEAR_M:
        fault = "the scan does not look alike to the left and to the right"
        raise ConfigError(
            f"{fault}; choose sectors by the task option scan, or no ppo.mirror."
        )
    return places


def _mirrored_actions(task: Task) -> tuple[Places, Array, Array]:
    places, signs = mirrored_commands(task.robot)
    if task.actions == "discrete":
        return (
            _mirrored_drives(task.discrete_commands, places, signs),
            np.zeros(0),
            np.zeros(0),
        )
    low, high = task.command_limits
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    return places, signs * half[places] / half, (signs * middle[places] - middle) / half


def mirrored_commands(spec: RobotSpec) -> tuple[NDArray[np.intp], Array]:
    """Places and signs (C,) by which commands drive a robot's mirror image about its x axis.

    It is driven by signs * command[..., places]. Commands that are fields of `cmd_vel` keep their
    places; for others, such as wheel speeds, the kinematics of the robot's kind tell. Raises
    ConfigError if they don't, or if its outline is not its own mirror image.
    """
    fix = "leave out ppo.mirror."
    if not _outline_is_symmetric(spec):
        fault = "its footprint is not the same on the left and on the right"
        raise ConfigError(f"robot {spec.name!r} has no mirror image, as {fault}; {fix}")
    if spec.takes_cmd_vel:
        return np.arange(len(spec.command)), SIGNS[list(spec.cmd_vel_places)]
    count = len(spec.command)
    if has_textbook(spec) and count <= MOST_SEARCHED:
        tried = np.random.default_rng(0).uniform(-1.0, 1.0, (TRIED, count))
        wanted = steady_twist(spec, tried) * SIGNS
        for order, signs in product(
            permutations(range(count)), product((1.0, -1.0), repeat=count)
        ):
            places = np.array(order, np.intp)
            factors = np.array(signs)
            if np.allclose(steady_twist(spec, tried[:, places] * factors), wanted):
                return places, factors
    fault = "which of its commands drive its mirror image is not known"
    raise ConfigError(
        f"robot {spec.name!r}: {fault}; give them `cmd_vel` fields, or {fix}"
    )


def _outline_is_symmetric(spec: RobotSpec) -> bool:
    if spec.footprint is None:
        return True
    corners = np.array(spec.footprint)
    apart = np.abs(corners[:, None] - corners * [1.0, -1.0]).max(axis=-1)
    return bool((apart.min(axis=1) <= 1e-6 * spec.footprint_radius).all())


def _mirrored_drives(commands: Array, places: Places, signs: Array) -> Places:
    """The mirror image (A,) of each drive, by their commands (A, C); each is that of one."""
    taken = np.zeros(len(commands), np.bool_)
    found = np.zeros(len(commands), np.intp)
    for k, wanted in enumerate(commands[:, places] * signs):
        alike = np.flatnonzero(np.isclose(commands, wanted).all(axis=1) & ~taken)
        if not len(alike):
            fault = "a discrete action has no mirror image, as limits of the commands differ"
            raise ConfigError(
                f"{fault}; use continuous actions, or leave out ppo.mirror."
            )
        found[k] = alike[0]
        taken[alike[0]] = True
    return found
