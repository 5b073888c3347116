"""In a mirrored world the mirrored actions lead to the mirrored observations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from robots import direct_model, field, lidar

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.mirror import mirror_of
from nics_drl_bridge.env.navigation import Navigation
from nics_drl_bridge.env.registry import make_task
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import open_model

MODEL = direct_model()


def world(side):
    """A field with one obstacle and a goal, on the left or right of a robot that looks ahead."""
    circle = {
        "shapes": [{"kind": "circle", "radius": 0.25}],
        "at": [[0.9, 0.7 * side, 0.0]],
    }
    return field(
        6.0,
        starts={"at": [[0.0, 0.1 * side, 0.3 * side]]},
        goals={"at": [[2.0, -0.5 * side]]},
        obstacles=[circle],
    )


@pytest.mark.parametrize("scan", [None, "around", {"sectors": 20, "range_max": 2.0}])
@pytest.mark.parametrize("actions", ["continuous", "discrete"])
def test_mirrored_actions_in_a_mirrored_world_show_the_mirrored_observation(
    scan, actions
):
    options = {"scan": scan, "actions": actions}
    left, right = (
        BridgeEnv("sim", MODEL, world(side), "navigation", task_options=options)
        for side in (1, -1)
    )
    mirror = left.unwrapped.task.mirror()
    seen, other = (env.reset(seed=1)[0] for env in (left, right))
    rng = np.random.default_rng(0)
    for _ in range(12):
        np.testing.assert_allclose(seen[mirror.places] * mirror.signs, other, atol=2e-5)
        if actions == "discrete":
            action = int(rng.integers(len(mirror.acted)))
            mirrored = int(mirror.acted[action])
        else:
            action = rng.uniform(-1.0, 1.0, 3).astype(np.float32)
            mirrored = np.float32(action[mirror.acted] * mirror.scale + mirror.offset)
        seen = left.step(action)[0]
        other = right.step(mirrored)[0]


def test_the_mirror_image_of_a_mirror_image_is_the_thing_itself():
    for robot in ("differential", "ackermann", "mecanum", "jackal"):
        for actions in ("continuous", "discrete"):
            task = make_task(
                "navigation", open_model(robot), {"actions": actions, "scan": "front"}
            )
            mirror = task.mirror()
            twice = mirror.places[mirror.places]
            assert twice.tolist() == list(range(len(twice)))
            assert (mirror.signs * mirror.signs[mirror.places] == 1.0).all()
            assert mirror.acted[mirror.acted].tolist() == list(range(len(mirror.acted)))


def test_limits_that_differ_on_both_sides_are_reckoned_with():
    robot = MODEL.robot.model_dump(mode="json")
    robot["command"][2] |= {"min": -1.0, "max": 3.0}
    task = Navigation(type(MODEL.robot).model_validate(robot), MODEL.lidar)
    mirror = task.mirror()
    action = np.array([0.3, 0.2, -0.4])  # -0.4 turns by 0.2 rad/s, to the left
    mirrored = action[mirror.acted] * mirror.scale + mirror.offset
    np.testing.assert_allclose(
        task.command(mirrored), task.command(action) * [1.0, -1.0, -1.0]
    )


@pytest.mark.parametrize(
    "sensor",
    [
        lidar(mount=(0.1, 0.05, 0.0)),
        lidar(mount=(0.1, 0.0, 0.02)),
        lidar(angle_min=-1.0, angle_max=2.0),
    ],
)
def test_a_scan_that_does_not_look_alike_to_both_sides_is_refused(sensor):
    with pytest.raises(
        ConfigError, match="does not look alike to the left and to the right"
    ):
        Navigation(MODEL.robot, sensor).mirror()


def test_a_lidar_whose_last_beam_is_its_first_or_not_has_a_mirror_image():
    for sensor in (
        lidar(beams=7),
        lidar(beams=8),
        lidar(angle_min=-1.0, angle_max=1.0, beams=5),
    ):
        mirror = Navigation(MODEL.robot, sensor).mirror()
        angles = sensor.angles[mirror.places[: sensor.beams]]
        np.testing.assert_allclose(np.cos(angles), np.cos(sensor.angles), atol=1e-9)
        np.testing.assert_allclose(np.sin(angles), -np.sin(sensor.angles), atol=1e-9)


@dataclass(frozen=True)
class Bare(Task):
    """A task that tells no mirror image."""

    parts: int = 2

    @cached_property
    def observation_space(self):
        return self.box([0.0, -math.pi], [1.0, math.pi])

    def reset(self, episodes):
        return {}

    observation = reward = end = None


def test_a_task_without_a_mirror_image_is_refused_and_a_wrong_one():
    task = Bare(MODEL.robot, MODEL.lidar)
    with pytest.raises(
        ConfigError, match="task Bare does not tell what it looks like in a mirror"
    ):
        task.mirror()
    with pytest.raises(
        ConfigError, match="mirrors 73 parts of an observation, which has 74"
    ):
        mirror_of(task, [1])
    with pytest.raises(
        ConfigError, match="part 72 lies from 0 to 1, its mirror image not"
    ):
        mirror_of(task, [-1, -1])
    assert mirror_of(task, [1, -1]).signs[-2:].tolist() == [1.0, -1.0]
