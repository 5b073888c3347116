from __future__ import annotations

import numpy as np
import pytest
import shapely

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.sim.world_set import Cellular, grow, load_worlds

GIVEN = Cellular(worlds=12, fill=(0.15, 0.32))


def cylinders(world):
    return np.array(
        [pose[:2] for group in world.obstacles for pose in group.at]
    ).reshape(-1, 2)


def test_equal_parameters_grow_equal_worlds_and_others_differ():
    assert grow(GIVEN, 3) == grow.__wrapped__(GIVEN, 3)
    other = GIVEN.model_copy(update={"seed": 1})
    different = {
        len(cylinders(world))
        for world in (*(grow(GIVEN, n) for n in range(6)), grow(other, 0))
    }
    assert len(different) > 4


def test_the_worlds_of_a_seed_stay_the_same():
    shipped = Cellular(worlds=2000, seed=7, fill=(0.2, 0.3), passage=0.75)
    counts = [len(cylinders(grow(shipped, n))) for n in range(8)]
    assert counts == [84, 114, 113, 195, 194, 101, 104, 138]


@pytest.mark.parametrize("number", range(8))
def test_a_disc_as_wide_as_the_passage_can_get_to_the_goal(number):
    world = grow(GIVEN, number)
    x1, y1, x2, y2 = world.bounds
    radius = (
        GIVEN.cell / 2.0 + GIVEN.passage / 2.0 - 0.02
    )  # the way is looked for on a grid
    solid = [shapely.Point(at).buffer(radius) for at in cylinders(world)]
    solid += [
        shapely.LineString([w[:2], w[2:]]).buffer(GIVEN.passage / 2.0 - 0.02)
        for w in world.walls
    ]
    free = shapely.box(x1, y1, x2, y2) - shapely.union_all(solid)
    start = shapely.Point(world.starts.at[0][:2])
    goal = shapely.Point(world.goals.at[0])
    assert any(
        area.contains(start) and area.contains(goal) for area in shapely.get_parts(free)
    )


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ("{kind: cellular}", "generate.worlds' is missing"),
        ("{kind: cellular, worlds: 2, fill: [0.5, 0.2]}", "fill must be"),
        ("{kind: cellular, worlds: 2, smoothing: [3, 1]}", "smoothing must be"),
        (
            "{kind: cellular, worlds: 2, passage: 5.0}",
            "passage may be at most as wide as margin",
        ),
        (
            "{kind: cellular, worlds: 2, rows: 1000, columns: 1000}",
            "columns times rows",
        ),
        ("{kind: cellular, worlds: 2, fill: [0.9, 0.9]}", "lower `fill`"),
        ("{kind: caves, worlds: 2}", "kind"),
    ],
)
def test_wrong_parameters_are_refused_in_one_sentence(tmp_path, given, reason):
    file = tmp_path / "set.yaml"
    file.write_text(f"name: s\ngenerate: {given}\n")
    with pytest.raises(ConfigError, match=reason) as refused:
        load_worlds(file)
    assert str(file) in str(refused.value)


def test_a_set_holds_what_is_generated_beside_what_is_named(tmp_path):
    file = tmp_path / "set.yaml"
    file.write_text(
        "name: s\nworlds: [circles]\ngenerate: {kind: cellular, worlds: 3}\n"
    )
    names = [world.name for world in load_worlds(file).members]
    assert names == ["circles", "cellular_0_0", "cellular_0_1", "cellular_0_2"]
