from __future__ import annotations

import math

import numpy as np
import pytest
from robots import circles, direct_model, field

from nics_drl_bridge.env.guide import Guide
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import WorldSet

MODEL = direct_model()
PLACES = {"starts": {"at": [[-3.0, 0.0, 0.0]]}, "goals": {"at": [[3.0, 0.0]]}}
APART = {"goal_distance": [1.0, 9.0], "clearance": 0.0, "obstacles": []}


def lengths_of(world, seeds=(0,), at=None):
    """Lengths of the ways from the starts, or from poses (N, 1, 3)."""
    simulator = FastSimulator(MODEL, world, len(seeds))
    scenes = simulator.reset(seeds)
    guide = Guide(simulator.sampler, footprint_shape(MODEL.robot), len(seeds))
    guide.begin(np.arange(len(seeds)), scenes)
    if at is not None:
        simulator.data.pose[...] = at
    return guide.measure_lengths(slice(0, len(seeds)), simulator.data)[:, 0], scenes


def walled(*walls, **changes):
    return field(
        9.0, **APART, **PLACES, walls=[list(wall) for wall in walls], **changes
    )


def test_where_nothing_stands_it_is_the_straight_distance():
    found, scenes = lengths_of(
        field(12.0, goal_distance=[1.0, 6.0], clearance=1.0), range(20)
    )
    straight = np.linalg.norm(scenes.starts[:, 0, :2] - scenes.goals[:, 0], axis=1)
    np.testing.assert_allclose(found, straight, rtol=0.08, atol=0.05)


def test_a_way_around_a_wall_is_as_long_as_a_string_around_its_end_and_a_little_more():
    (found,), _ = lengths_of(walled((0.0, -4.5, 0.0, 2.0)))
    assert 2.0 * math.hypot(3.0, 2.0) < found < 2.0 * math.hypot(3.0, 2.0) + 2.0


def test_a_tight_gap_costs_more_than_a_wide_one_but_less_than_a_long_way_round():
    radius = MODEL.robot.footprint_radius

    def through(half):
        (found,), _ = lengths_of(walled((0.0, -4.5, 0.0, -half), (0.0, half, 0.0, 2.0)))
        return found

    (around,), _ = lengths_of(walled((0.0, -4.5, 0.0, 2.0)))
    wide = through(1.2)
    tight = through(radius + 0.1)
    assert wide == pytest.approx(6.0, abs=0.1)
    assert wide + 0.1 < tight < around


def test_every_place_has_a_way_even_one_within_an_obstacle():
    group = {"shapes": [{"kind": "circle", "radius": 1.0}], "at": [[0.0, 0.0, 0.0]]}
    world = field(9.0, **(APART | {"obstacles": [group]}), **PLACES)
    (inside,), _ = lengths_of(world, at=[[[0.0, 0.0, 0.0]]])
    assert 3.0 < inside < 20.0


def test_a_box_is_in_the_way_as_it_stands_and_what_moves_is_not():
    box = {
        "shapes": [{"kind": "rectangle", "size": [0.2, 4.0]}],
        "at": [[0.0, 0.0, 0.0]],
    }
    along = box | {"at": [[0.0, 0.0, math.pi / 2.0]]}
    across, beside = (
        lengths_of(field(9.0, **(APART | {"obstacles": [group]}), **PLACES))[0][0]
        for group in (box, along)
    )
    assert across > 2.0 * math.hypot(3.0, 2.0)
    assert beside < across
    moving = circles(8, radii=(0.4,)) | {
        "motion": {"kind": "pedestrian", "speed": [0.2, 0.4]}
    }
    crowd = field(9.0, **(APART | {"obstacles": [moving]}), **PLACES)
    assert lengths_of(crowd)[0][0] == pytest.approx(6.0, abs=0.1)


def test_worlds_of_a_set_have_their_own_ways():
    one = walled((0.0, -4.5, 0.0, 2.0))
    other = World.model_validate(
        {
            "name": "long",
            "size": [30.0, 6.0],
            **APART,
            **PLACES,
            "goal_distance": [1.0, 30.0],
        }
    )
    seeds = range(12)
    found, scenes = lengths_of(WorldSet("two", (one, other)), seeds)
    alone = [lengths_of(world)[0][0] for world in (one, other)]
    np.testing.assert_allclose(found, np.array(alone)[scenes.member], rtol=1e-6)
    assert len(set(scenes.member.tolist())) == 2
