"""A fitted textbook is written as terms, which move a robot as the textbook does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identify.drives import make_model
from nics_drl_bridge.identify.textbook import (
    TextbookResponse,
    Yardstick,
    make_textbook_model,
    probe_structure,
)
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot.kinds import compute_steady_twist, textbook
from nics_drl_bridge.robot.spec import RobotSpec, build_robot, load_robot
from nics_drl_bridge.robot.taylor import TaylorModel

DT = 0.02
LAG_S = 0.1
RATE = (1.0 - np.exp(-DT / LAG_S)) / DT


def written(spec: RobotSpec, most: float = 0.5) -> tuple[TaylorModel, np.ndarray]:
    """Returns a robot's textbook as terms, and rows of variables within a share of their limits."""
    moves, bicycle = probe_structure(spec)
    limits = np.array([[v.min, v.max] for v in (*spec.state, *spec.command)]).T
    x = np.random.default_rng(0).uniform(*(most * limits), (400, limits.shape[1]))
    nothing = np.zeros((400, 3 + len(spec.state)))
    samples = Samples(DT * np.arange(400), nothing, x, nothing, DT)
    response = TextbookResponse(
        delay_s=0.0,
        gain=moves,
        offset=np.zeros(3),
        lag_s=np.full(3, LAG_S),
        limit=np.array([2.0, 3.0]),
        bicycle=bicycle,
        mounting=np.zeros(3),
    )
    like = make_model(spec, {"vx": {}}, dt=DT)
    model = make_textbook_model(Yardstick(response, 0.0), like, samples, spec)
    assert model is not None
    return model, x


def without_limits(model: TaylorModel) -> TaylorModel:
    return replace(model, limits=np.zeros((0, 2)))


@pytest.mark.parametrize("name", ["ackermann", "differential", "mecanum"])
def test_states_follow_the_commands_and_move_the_robot(name):
    spec = load_robot(name)
    model, x = written(spec)
    state, command = np.split(x, [len(spec.state)], axis=1)
    book = textbook(spec)
    rates = without_limits(model).rates(x)
    twist = book.twist(state)
    assert rates[:, :3] == pytest.approx(twist, abs=0.02 * np.abs(twist).max())
    assert rates[:, 3:] == pytest.approx(
        RATE * (book.target(command) - state), rel=1e-3, abs=1e-3
    )
    limited = [v.name == "speed" for v in spec.state]
    assert model.limits[limited].tolist() == [[-3.0, 2.0]] * sum(limited)
    assert not np.isfinite(model.limits[np.logical_not(limited)]).any()


@pytest.mark.parametrize("name", ["differential", "ackermann"])
def test_a_robot_without_a_state_moves_by_its_commands(name):
    spec = load_robot(name).model_copy(update={"state": ()})
    model, x = written(spec)
    twist = compute_steady_twist(spec, x)
    assert model.rates(x) == pytest.approx(twist, abs=0.02 * np.abs(twist).max())


def test_a_twist_that_is_the_state_follows_the_commands():
    spec = build_robot({"kind": "omnidirectional", "footprint_radius": 0.2})
    model, x = written(spec)
    rates = without_limits(model).rates(x)
    assert rates[:, :3] == pytest.approx(x[:, :3], abs=1e-3)
    goal = compute_steady_twist(spec, x[:, 3:])
    assert rates[:, 3:] == pytest.approx(RATE * (goal - x[:, :3]), rel=1e-3, abs=1e-3)
    assert model.limits[0].tolist() == [-3.0, 2.0]
