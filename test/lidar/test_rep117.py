from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.lidar.spec import from_device, load_lidar, to_device

CONVENTIONS = {"inf": np.inf, "zero": 0.0, "nan": np.nan, "range_max": 3.0}
DEVICES = [
    "rplidar_a1",
    "rplidar_a2",
    "hokuyo_ust_10lx",
    "sick_tim571",
    "turtlebot3_lds_02",
]


@pytest.mark.parametrize("no_return", CONVENTIONS)
def test_only_no_return_is_rewritten_on_the_way_out(no_return):
    ranges = np.array([0.05, 1.0, -np.inf, np.nan, np.inf], np.float32)
    before = ranges.copy()
    wire = to_device(ranges, lidar(no_return=no_return))
    assert wire.dtype == np.float32
    assert np.array_equal(wire[:4], ranges[:4], equal_nan=True)
    assert np.array_equal(wire[4], CONVENTIONS[no_return], equal_nan=True)
    assert np.array_equal(ranges, before, equal_nan=True)


@pytest.mark.parametrize(
    ("no_return", "said", "meant"),
    [
        ("inf", np.inf, np.inf),
        ("inf", np.nan, np.nan),
        ("inf", 0.0, -np.inf),  # no word for no return here, so something may be there
        ("inf", 3.1, np.inf),
        ("inf", 0.04, -np.inf),
        ("inf", -1.0, -np.inf),
        ("inf", 3.0, 3.0),
        ("zero", 0.0, np.inf),
        ("zero", -0.0, np.inf),
        ("zero", 0.04, -np.inf),
        ("zero", np.nan, np.nan),
        ("nan", np.nan, np.inf),
        ("nan", 0.0, -np.inf),
        ("range_max", 3.0, np.inf),
        ("range_max", 2.999, 2.999),
        ("range_max", 65.533, np.inf),
    ],
)
def test_what_a_device_says_is_taken_as_what_it_means(no_return, said, meant):
    spec = lidar(no_return=no_return)
    assert np.array_equal(
        from_device([said], spec), np.array([meant], np.float32), equal_nan=True
    )
    assert from_device([-np.inf], spec)[0] == -np.inf


@pytest.mark.parametrize("name", DEVICES)
def test_scans_come_back_from_every_shipped_device(name):
    spec = load_lidar(name)
    # In float32 some limits are a little less or more than in the file; they are returns.
    limits = np.array([spec.range_min, spec.range_max], np.float32)
    inside = np.random.default_rng(0).uniform(*limits, 500).astype(np.float32)
    ranges = np.concatenate([limits, inside, np.array([np.inf, -np.inf], np.float32)])
    assert np.array_equal(from_device(to_device(ranges, spec), spec), ranges)
