from __future__ import annotations

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.sector_kernels import resample
from nics_drl_bridge.lidar.sectors import (
    LAYOUTS,
    Reader,
    ScanLayout,
    layout_of,
    make_reader,
    make_sector_plan,
)
from nics_drl_bridge.lidar.spec import ScanHeader, load_lidar

AROUND = ScanLayout(sectors=72, range_max=3.0)
SHIPPED = (
    "paper",
    "paper_12m",
    "rplidar_a1",
    "rplidar_a2",
    "hokuyo_ust_10lx",
    "jackal_hokuyo",
    "sick_tim571",
    "turtlebot3_lds_02",
)


def room(origin, angles, half=(2.0, 1.5)):
    """Ranges (B,) to the walls of a rectangle around the world's origin, in closed form."""
    along = [
        np.abs(np.copysign(half[i], d) - origin[i]) / np.maximum(np.abs(d), 1e-9)
        for i, d in enumerate((np.cos(angles), np.sin(angles)))
    ]
    return np.minimum(*along).astype(np.float32)


def nearest_of(spec, ranges, layout):
    """The definition, slowly: the nearest return of the beams in each sector."""
    out = np.full(layout.sectors, np.nan)
    for s, middle in enumerate(layout.angles):
        away = np.angle(np.exp(1j * (spec.angles + spec.mount[2] - middle)))
        mine = ranges[np.abs(away) <= layout.width / 2 + 1e-4]
        mine = mine[~np.isnan(mine)]
        out[s] = mine.min() if len(mine) else np.nan
    return out


def resampled(plan, ranges):
    """Nearest returns (S,) of a scan (B,)."""
    out = np.empty(len(plan.first), np.float32)
    resample(out, np.ascontiguousarray(ranges, np.float32), plan)
    return out


def header(spec, **changes):
    return ScanHeader(**{**spec.header._asdict(), **changes})


@pytest.mark.parametrize("heading", [0.0, 0.3, -2.0, np.pi])
@pytest.mark.parametrize("angles", [(-np.pi, np.pi), (0.0, 2.0 * np.pi)])
def test_a_sector_holds_the_nearest_return_of_its_beams(heading, angles):
    spec = lidar(
        beams=720, angle_min=angles[0], angle_max=angles[1], mount=(0.0, 0.0, heading)
    )
    rng = np.random.default_rng(1)
    ranges = rng.uniform(0.1, 3.0, 720).astype(np.float32)
    ranges[rng.random(720) < 0.4] = rng.choice([np.nan, np.inf, -np.inf], 1)
    ours = resampled(make_sector_plan(spec, AROUND), ranges)
    assert np.array_equal(ours, nearest_of(spec, ranges, AROUND), equal_nan=True)


def test_a_coarse_lidar_gives_a_sector_the_nearer_of_the_beams_beside_it():
    spec = lidar(beams=36)
    ranges = np.arange(36, dtype=np.float32) / 36.0
    seen = resampled(
        make_sector_plan(spec, ScanLayout(sectors=360, range_max=3.0)), ranges
    )
    assert np.isfinite(seen).all()
    assert seen[15] == ranges[1]  # between beams 1 and 2
    assert seen[-5] == ranges[0]  # between the last and the first


def test_what_was_not_measured_stays_unknown_and_what_is_too_close_wins():
    ranges = np.full(720, 2.0, np.float32)
    plan = make_sector_plan(lidar(beams=720), AROUND)
    ranges[0:11], ranges[100], ranges[200], ranges[305] = (
        np.nan,
        -np.inf,
        np.nan,
        np.inf,
    )
    seen = resampled(plan, ranges)
    assert np.isnan(seen[0])
    assert seen[10] == -np.inf
    assert seen[20] == 2.0
    assert seen[30] == 2.0
    assert resampled(plan, np.full(720, np.inf, np.float32)).tolist() == [np.inf] * 72


@pytest.mark.parametrize("mount", [(0.2, 0.0, 0.0), (-0.15, 0.1, 1.0)])
def test_a_lidar_mounted_elsewhere_sees_what_one_at_the_viewpoint_does(mount):
    spec = lidar(beams=1440, range_max=6.0, mount=mount)
    seen = resampled(
        make_sector_plan(spec, AROUND),
        room(np.array(mount[:2]), spec.angles + mount[2]),
    )
    fine = np.linspace(-AROUND.width / 2, AROUND.width / 2, 201)
    exact = room(np.zeros(2), AROUND.angles[:, None] + fine).min(axis=1)
    assert np.abs(seen - exact).max() < 0.03


def test_a_moved_lidar_sees_free_space_as_free_and_tells_what_is_too_close():
    plan = make_sector_plan(lidar(beams=720, mount=(0.2, 0.0, 0.0)), AROUND)
    ranges = np.full(720, np.inf, np.float32)
    assert resampled(plan, ranges).tolist() == [np.inf] * 72
    ranges[360] = -np.inf
    assert resampled(plan, ranges)[[35, 36]].min() == -np.inf


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angle_min": -1.0, "angle_max": 1.0}, "looks from -57.3 to 57.3 deg"),
        ({"beams": 20}, "18 deg apart"),
        ({"range_max": 2.0}, "range_max"),
    ],
)
def test_a_lidar_that_cannot_fill_the_layout_is_refused_in_one_sentence(changes, words):
    with pytest.raises(ConfigError, match=words) as refused:
        make_sector_plan(lidar(**changes), AROUND)
    assert str(refused.value).count(". ") == 0


def test_a_layout_is_given_by_name_number_or_fields():
    spec = lidar(angle_min=-1.0, angle_max=2.0, mount=(0.1, 0.0, 3.0))
    assert layout_of(None, spec) is None
    assert layout_of("around", spec) == LAYOUTS["around"]
    assert layout_of({"sectors": 36, "range_max": 2.0}, spec).sectors == 36
    own = layout_of(30, spec)
    assert (own.sectors, own.range_max, own.viewpoint) == (30, 3.0, (0.1, 0.0))
    plan = make_sector_plan(spec, own)
    assert plan.hits.min() >= 1
    assert plan.shift.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("arund", "did you mean 'around'"),
        ({"sectors": 36}, "'range_max' is missing"),
        ({"sectors": 36, "range_max": 1.0, "beams": 3}, "unknown key 'beams'"),
        (2, "sectors"),
        ({"sectors": 36, "range_max": 1.0, "angle_min": 9.0}, "angle"),
    ],
)
def test_a_wrong_layout_is_refused_with_the_fix(given, words):
    with pytest.raises(ConfigError, match=words):
        layout_of(given, lidar())


def reader_sees(reader: Reader, ranges, layout=AROUND):
    return resampled(make_sector_plan(reader.lidar, layout), reader.ordered(ranges))


def test_a_header_gives_back_its_lidar():
    for name in SHIPPED:
        spec = load_lidar(name)
        found = make_reader(spec.header, spec.beams, spec)
        assert not found.backwards
        assert found.lidar.angles == pytest.approx(spec.angles, abs=1e-6)


def test_beams_that_come_clockwise_are_put_in_order():
    spec = lidar(beams=720)
    ranges = room(np.array([0.3, 0.4]), spec.angles)
    clockwise = header(
        spec,
        angle_min=spec.header.angle_max,
        angle_max=spec.header.angle_min,
        angle_increment=-spec.angle_increment,
    )
    found = make_reader(clockwise, 720, spec)
    assert np.array_equal(
        reader_sees(found, ranges[::-1]),
        resampled(make_sector_plan(spec, AROUND), ranges),
    )


def test_a_lidar_that_hangs_upside_down_turns_the_other_way():
    spec = lidar(beams=720)
    below = room(np.array([0.3, 0.4]), -spec.angles)
    found = make_reader(spec.header, 720, spec, upside_down=True)
    upright = room(np.array([0.3, 0.4]), spec.angles)
    assert reader_sees(found, below) == pytest.approx(
        resampled(make_sector_plan(spec, AROUND), upright)
    )


@pytest.mark.parametrize(
    ("beams", "changes"),
    [
        (720, {"angle_min": 3.0 * np.pi}),
        (721, {"angle_max": np.pi}),
        (720, {"angle_increment": np.float32(2.0 * np.pi / 720)}),
    ],
)
def test_odd_headers_of_a_full_circle_are_understood(beams, changes):
    found = make_reader(header(lidar(beams=720), **changes), beams, lidar())
    assert found.lidar.beams == beams
    assert found.lidar.angle_increment == pytest.approx(2.0 * np.pi / 720, rel=2e-3)
    make_sector_plan(found.lidar, AROUND)


@pytest.mark.parametrize(
    ("beams", "changes"),
    [
        (1, {}),
        (720, {"angle_increment": 0.0}),
        (720, {"angle_min": np.nan}),
        (720, {"angle_increment": 0.1}),
        (720, {"range_max": 0.0}),
    ],
)
def test_a_header_that_describes_no_lidar_is_refused(beams, changes):
    with pytest.raises(ConfigError, match="LaserScan"):
        make_reader(header(lidar(beams=720), **changes), beams, lidar())
