from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.extras.nav2.route import route
from nics_drl_bridge.sim.occupancy import occupancy
from nics_drl_bridge.sim.world_set import load_worlds

START = (-2.0, -3.0)
GOAL = (5.5, 3.0)
RADIUS = 0.2


@pytest.fixture(scope="module")
def room():
    return occupancy(load_worlds("room"))


def test_a_way_leads_through_doors_and_touches_nothing(room):
    way = route(room, START, GOAL, RADIUS)
    assert (tuple(way[0]), tuple(way[-1])) == (START, GOAL)
    cells = room.world_to_cell(way[1:-1])
    assert room.distance_field[cells[:, 0], cells[:, 1]].min() > RADIUS
    assert np.hypot(*np.diff(way, axis=0).T).max() < 0.3


def test_a_robot_that_fits_through_no_door_gets_one_sentence(room):
    with pytest.raises(ConfigError, match="there is no path to the goal on the map"):
        route(room, START, GOAL, 0.9)


@pytest.mark.parametrize("name", ["start", "goal"])
def test_an_end_off_the_map_is_told(room, name):
    ends = {"start": START, "goal": GOAL, name: (50.0, 0.0)}
    with pytest.raises(ConfigError, match=f"the {name} of the path is off the map"):
        route(room, ends["start"], ends["goal"], RADIUS)


LOADED_LATER = """
import sys
import numpy as np
from nics_drl_bridge.lidar.maps import GridMap
from nics_drl_bridge.extras.nav2.route import route, warm_up
warm_up()
loaded = set(sys.modules)
cells = np.zeros((30, 30), np.int8)
cells[10:20, 15] = 100
route(GridMap(cells, 0.1), (0.5, 1.5), (2.5, 1.5), 0.2)
print(sorted(set(sys.modules) - loaded))
"""


def test_a_route_loads_nothing_after_the_warm_up():
    done = subprocess.run(
        [sys.executable, "-c", LOADED_LATER], capture_output=True, text=True
    )
    assert done.stdout.strip() == "[]", done.stderr
