"""Left and right exchanged: the commands that drive a robot's mirror image about its x axis."""

from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.robot.kinds import has_textbook, steady_twist
from nics_drl_bridge.robot.spec import RobotSpec

SIGNS = np.array([1.0, -1.0, -1.0])  # of vx, vy and wz in a mirror
MOST_SEARCHED, TRIED = 4, 8  # commands that can be searched; twists that have to agree


def mirrored_commands(spec: RobotSpec) -> tuple[NDArray[np.intp], Array]:
    """Places and signs (C,): the mirror image is driven by signs * command[..., places].

    Commands that are fields of `cmd_vel` keep their places; for others, such as wheel speeds, the
    kinematics of the robot's kind tell. Raises ConfigError if they don't, or if its outline is not
    its own mirror image.
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
        for order, signs in product(permutations(range(count)), product((1.0, -1.0), repeat=count)):
            places, factors = np.array(order, np.intp), np.array(signs)
            if np.allclose(steady_twist(spec, tried[:, places] * factors), wanted):
                return places, factors
    fault = "which of its commands drive its mirror image is not known"
    raise ConfigError(f"robot {spec.name!r}: {fault}; give them `cmd_vel` fields, or {fix}")


def _outline_is_symmetric(spec: RobotSpec) -> bool:
    if spec.footprint is None:
        return True
    corners = np.array(spec.footprint)
    apart = np.abs(corners[:, None] - corners * [1.0, -1.0]).max(axis=-1)
    return bool((apart.min(axis=1) <= 1e-6 * spec.footprint_radius).all())
