"""Mirror: what a robot sees and does with left and right exchanged, for a training."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nics_drl_bridge.env.task import Mirror, Sight, Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array, wrap_angle
from nics_drl_bridge.robot.mirror import mirrored_commands

Places = NDArray[np.intp]
NEAR_RAD, NEAR_M = 1e-4, 1e-6  # by which a scan may be off its mirror image: angles are float32


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
        fault = f"mirrors {len(places)} parts of an observation, which has {space.shape[0]}"
        raise ConfigError(f"task {name}: {fault}; give a sign to each that follows the scan.")
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
        raise ConfigError(f"{fault}; choose sectors by the task option scan, or no ppo.mirror.")
    return places


def _mirrored_actions(task: Task) -> tuple[Places, Array, Array]:
    places, signs = mirrored_commands(task.robot)
    if task.actions == "discrete":
        return _mirrored_drives(task.discrete_commands, places, signs), np.zeros(0), np.zeros(0)
    low, high = task.command_limits
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return places, signs * half[places] / half, (signs * middle[places] - middle) / half


def _mirrored_drives(commands: Array, places: Places, signs: Array) -> Places:
    """The mirror image (A,) of each drive, by their commands (A, C); each is that of one."""
    taken = np.zeros(len(commands), np.bool_)
    found = np.zeros(len(commands), np.intp)
    for k, wanted in enumerate(commands[:, places] * signs):
        alike = np.flatnonzero(np.isclose(commands, wanted).all(axis=1) & ~taken)
        if not len(alike):
            fault = "a discrete action has no mirror image, as limits of the commands differ"
            raise ConfigError(f"{fault}; use continuous actions, or leave out ppo.mirror.")
        found[k], taken[alike[0]] = alike[0], True
    return found
