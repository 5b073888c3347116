from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import ImageColor
from robots import direct_model, field

from nics_drl_bridge import extensions
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.rendering import ROBOTS
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.snapshot import find_gate
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import RobotSpec


def pixel(colour):
    return np.array(ImageColor.getrgb(colour))


BLUE = pixel(ROBOTS[0])


def env(mode, **arguments):
    return BridgeEnv(
        model=direct_model(), world=field(count=2), render_mode=mode, **arguments
    )


def blue_at(picture):
    """Mean row and column of the first robot's pixels, in shares of the picture."""
    rows, columns = np.nonzero((np.abs(picture.astype(int) - BLUE) < 3).all(axis=-1))
    return rows.mean() / picture.shape[0], columns.mean() / picture.shape[1]


def test_a_picture_shows_the_robot_where_it_stands():
    shown = env("rgb_array")
    shown.reset(seed=0, options={"start": (1.5, -1.5, 0.0)})
    picture = shown.render()
    assert picture.dtype == np.uint8
    assert picture.shape == (500, 500, 3)
    assert blue_at(picture) == pytest.approx(
        (0.5 + 1.5 / 6.6, 0.5 + 1.5 / 6.6), abs=0.02
    )
    for _ in range(5):
        shown.step(np.array([1.0, 0.0, 0.0], np.float32))
    row, column = blue_at(shown.render())
    assert row == pytest.approx(0.5 + 1.5 / 6.6, abs=0.02)
    assert column > 0.5 + 1.9 / 6.6


def test_every_robot_of_a_team_is_drawn():
    shown = env("rgb_array", task="cooperative_reaching")
    shown.reset(seed=1)
    picture = shown.render().reshape(-1, 3).astype(int)
    for colour in ROBOTS[:3]:
        assert (np.abs(picture - pixel(colour)) < 3).all(axis=-1).sum() > 100


@pytest.mark.parametrize("method", ["reset", "step"])
def test_render_mode_human_shows_each_reset_and_step_on_the_viewer(monkeypatch, method):
    shown = []
    closed = []

    class Viewer:
        def __init__(self, model, world, fps):
            self.close = lambda: closed.append(fps)
            self.draw = shown.append

    monkeypatch.setattr(extensions, "load", lambda group, name: Viewer)
    env_ = env("human", backend=SimBackend(direct_model(), field(count=2)))
    env_.reset(seed=0)
    if method == "step":
        env_.step(np.array([1.0, 0.0, 0.0], np.float32))
    assert [shot.step for shot in shown] == [0, 1][: 1 + (method == "step")]
    env_.close()
    assert closed == [10]


def test_a_shot_tells_command_estimate_covariance_and_gate():
    shown = env(None, estimator=True)
    shown.reset(seed=0)
    assert shown.snapshot().covariance is None
    shown.step(np.array([1.0, 0.0, 0.0], np.float32))
    shot = shown.snapshot()
    assert shot.commands == pytest.approx(np.array([[2.0, 0.0, 0.0]]))
    assert np.all(np.linalg.eigvalsh(shot.covariance[0]) > 0.0)
    assert shot.estimates == pytest.approx(shot.poses, abs=0.05)
    assert (shot.gate, shot.step) == (None, 1)


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({}, None),
        ({"stopped_by": "", "shielded": False}, ""),
        ({"stopped_by": "", "shielded": True}, "shield"),
        ({"stopped_by": "scan age", "shielded": True}, "scan age"),
    ],
)
def test_a_shot_tells_what_the_gate_did(info, said):
    assert find_gate(info) == said


def test_nothing_is_drawn_without_a_mode_and_an_unknown_one_is_refused():
    quiet = env(None)
    quiet.reset(seed=0)
    assert quiet.render() is None
    with pytest.raises(
        ConfigError, match="unknown render_mode 'rgb_aray'; did you mean"
    ):
        env("rgb_aray")


def test_a_vector_env_draws_what_its_single_envs_draw():
    vector = BridgeVectorEnv(
        2, model=direct_model(), world=field(count=2), render_mode="rgb_array"
    )
    vector.reset(seed=3)
    pictures = vector.render()
    for n in range(2):
        alone = env("rgb_array")
        alone.reset(seed=3 + n)
        assert np.array_equal(pictures[n], alone.render())


def test_a_world_that_is_a_map_is_drawn_to_its_edges():
    shown = BridgeEnv(world="room", render_mode="rgb_array")
    shown.reset(seed=0)
    picture = shown.render()
    assert max(picture.shape) == 500
    dark = (picture.max(axis=-1) < 80).sum()
    assert dark > 500  # the walls of the map


def test_a_footprint_of_corners_is_drawn_with_its_corners():
    model = direct_model()
    long = [(-0.8, -0.1), (0.8, -0.1), (0.8, 0.1), (-0.8, 0.1)]
    about = model.robot.model_dump() | {"footprint": long}
    about.pop("footprint_radius")
    model = replace(model, robot=RobotSpec.model_validate(about))
    shown = BridgeEnv(model=model, world=field(count=0), render_mode="rgb_array")
    shown.reset(seed=0, options={"start": (0.0, 0.0, np.pi / 2.0)})
    rows, columns = np.nonzero(
        (np.abs(shown.render().astype(int) - BLUE) < 3).all(axis=-1)
    )
    scale = 500 / 6.6  # pixels per metre
    assert np.ptp(rows) == pytest.approx(1.6 * scale, abs=4)
    assert np.ptp(columns) == pytest.approx(0.2 * scale, abs=4)
