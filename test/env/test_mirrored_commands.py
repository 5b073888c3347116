"""A robot's mirror image is driven by commands of which some change places or signs."""

from __future__ import annotations

import numpy as np
import pytest

from nics_drl_bridge.env.mirror import mirrored_commands
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.kinds import steady_twist
from nics_drl_bridge.robot.spec import load_robot, robot_from

SIZE = {"footprint_radius": 0.2}


@pytest.mark.parametrize(
    ("robot", "places", "signs"),
    [
        ("differential", [0, 1], [1, -1]),
        ("ackermann", [0, 1], [1, -1]),
        ("mecanum", [0, 1, 2], [1, -1, -1]),
        ({"kind": "differential_wheels"}, [1, 0], [1, 1]),
        ({"kind": "ackermann_throttle"}, [0, 1], [1, -1]),
        (
            {
                "kind": "mecanum",
                "command": [
                    {
                        "name": f"{end}_{side}_wheel",
                        "unit": "rad/s",
                        "min": -9.0,
                        "max": 9.0,
                    }
                    for end in ("front", "rear")
                    for side in ("left", "right")
                ],
            },
            [1, 0, 3, 2],
            [1, 1, 1, 1],
        ),
    ],
)
def test_commands_of_the_mirror_image_lead_to_the_mirrored_twist(robot, places, signs):
    spec = load_robot(robot) if isinstance(robot, str) else robot_from(robot | SIZE)
    found, factors = mirrored_commands(spec)
    assert (found.tolist(), factors.tolist()) == (places, signs)
    commands = np.random.default_rng(1).uniform(-0.4, 0.4, (20, len(spec.command)))
    mirrored = steady_twist(spec, commands) * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(
        steady_twist(spec, commands[:, found] * factors), mirrored, atol=1e-12
    )


def test_an_outline_that_is_not_the_same_on_both_sides_is_refused():
    outline = [[0.3, 0.2], [-0.2, 0.2], [-0.2, -0.1], [0.3, -0.1]]
    spec = robot_from({"kind": "differential", "footprint": outline})
    with pytest.raises(
        ConfigError, match="its footprint is not the same on the left and on the"
    ):
        mirrored_commands(spec)
    assert mirrored_commands(load_robot("jackal"))[1].tolist() == [1, -1]


def test_commands_of_which_nothing_tells_where_they_lead_are_refused():
    command = [{"name": "a", "unit": "1", "min": -1.0, "max": 1.0}]
    spec = robot_from({"name": "odd", "footprint_radius": 0.2, "command": command})
    with pytest.raises(
        ConfigError, match="robot 'odd': which of its commands drive its mirror"
    ):
        mirrored_commands(spec)
