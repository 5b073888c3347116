"""Every benchmark of the lidar in small: its JSON has all keys, its errors stay below the bars."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from nics_drl_bridge.lidar.bake import bake

from .runs import asked, fails

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SCENES = ["circle", "square", "strip", "mixture"]
CACHE = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nics_drl_bridge"
)
PEERS = ("ir_sim", "irsim_x")


def result_of(script: str, *options: str, **variables: str) -> dict:
    """The one JSON object that a benchmark prints, in an environment of its own."""
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / script), "--json", *options],
        capture_output=True,
        text=True,
        check=True,
        timeout=110,
        env={**os.environ, **variables},
    )
    assert done.stdout.count("\n") == 1
    return json.loads(done.stdout)


def missed_but(result: dict, *words: str) -> list[str]:
    """The bars that were missed, but for those of speed, which short runs do not settle."""
    return [
        line for line in result["failures"] if not any(word in line for word in words)
    ]


@pytest.fixture(scope="module")
def scenes(monkeypatch_module):
    monkeypatch_module.syspath_prepend(str(BENCHMARKS))
    from measuring import scenes

    return scenes


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.mark.campaign
def test_table2_is_below_a_third_of_the_nearest_rows_errors_in_every_scene():
    _, result = asked("table2_lidar.py", "--scans", "512", "--repeats", "2")
    assert not missed_but(result, "as fast as exact", "of the write limit")
    assert list(result["scenes"]) == SCENES
    for name, scene in result["scenes"].items():
        assert scene["rmse_m"] <= 0.03, name
        assert scene["rmse_m"] <= scene["nearest_row_rmse_m"] / 3.0, name
        assert scene["area_rmse_m2"] <= scene["nearest_row_area_rmse_m2"] / 3.0, name
        assert scene["exact_scans_per_s"] > 0.0
        assert scene["baked_scans_per_s"] > 0.0
        assert result["table_bytes"][name] > 0
        assert result["bake_s"][name] > 0.0
    assert result["write_limit_scans_per_s"] > 0.0


@pytest.mark.campaign
def test_table3_shows_that_half_the_distances_cost_a_plain_look_up_more_than_half_the_rotations():
    code, result = asked("table3_density.py", "--scans", "256")
    assert (code, result["failures"]) == (0, [])
    for density in ("100x240", "50x240", "100x120"):
        assert list(result[density]) == SCENES
        assert list(result["nearest_row"][density]) == SCENES
        for name in SCENES:
            assert result[density][name] <= result["nearest_row"][density][name] / 3.0
    plain = result["times_worse"]["nearest_row"]
    assert plain["50x240"] > 1.3 > plain["100x120"]


@pytest.mark.campaign
def test_complexity_names_a_cost_for_every_number_of_vertices():
    options = ("--most", "16", "--scans", "32", "--repeats", "2")
    _, result = asked(
        "lidar_complexity.py", *options, "--distances", "10", "--rotations", "8"
    )
    assert result["vertices"] == [4, 8, 16]
    for key in ("exact_us", "baked_us"):
        assert len(result[key]) == 3
        assert min(result[key]) > 0.0


@pytest.mark.campaign
def test_peers_are_null_with_a_reason_where_they_cant_be_installed(tmp_path):
    options = ("--scans", "32", "--scenes", "1", "--repeats", "2")
    nowhere = {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull}
    cache = {"XDG_CACHE_HOME": str(tmp_path), "PIP_FIND_LINKS": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "lidar_peers.py"), "--json", *options],
        capture_output=True,
        text=True,
        timeout=280,
        env={**os.environ, **nowhere, **cache},
    )
    result = json.loads(done.stdout)
    assert result["baked"] > 0.0
    assert result["exact"] > 0.0
    assert result["rmse_m"]["baked"] < 0.01
    for peer in ("ir_sim", "irsim_x"):
        assert result[peer] is None
        assert "can't be installed" in result["missing"][peer]
    assert result["agreement"] == result["times_as_fast_at_equal_work"] == {}
    assert not [line for line in result["failures"] if not line.startswith("share_of_")]
    assert not any(path.name == ".ready" for path in tmp_path.rglob("*"))


WITHOUT_PEERS = ("--scans", "64", "--scenes", "4", "--repeats", "2", "--without-peers")


@pytest.mark.campaign
def test_a_scan_that_is_turned_by_one_beam_is_not_the_same_scan():
    missed = fails("lidar_peers.py", "shifted", *WITHOUT_PEERS)
    assert any(line.startswith("rmse_m of baked: ") for line in missed)


@pytest.mark.campaign
def test_a_scanner_that_is_ten_times_slower_misses_its_bar():
    missed = fails("lidar_peers.py", "slow", *WITHOUT_PEERS)
    assert any(line.startswith("share_of_write_limit: ") for line in missed)


@pytest.mark.campaign
@pytest.mark.timeout(400)
def test_a_scan_that_is_not_that_of_a_step_does_not_agree_with_it():
    ready = [
        next(CACHE.glob(f"{name}-py3.{sys.version_info[1]}/.ready"), None)
        for name in PEERS
    ]
    if not all(ready):
        pytest.skip(
            f"needs the other simulators, which lidar_peers.py installs below {CACHE}"
        )
    few = ("--scans", "32", "--scenes", "4", "--repeats", "2")
    missed = fails("lidar_peers.py", "other_way", *few)
    assert any(line.startswith("agreement of irsim_x: ") for line in missed)
    assert not any("rmse_m" in line for line in missed)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"share_of_write_limit": float("nan")}, "share_of_write_limit"),
        (
            {"times_as_fast_at_equal_work": {"ir_sim": 600.0}},
            "times_as_fast_at_equal_work",
        ),
        (
            {"times_as_fast_at_equal_work": {"irsim_x": 5.0}},
            "times_as_fast_at_equal_work",
        ),
        ({"rmse_m": {"irsim_x": 0.13}}, "rmse_m of irsim_x"),
        ({"rmse_m": {"ir_sim": float("nan")}}, "rmse_m of ir_sim"),
    ],
)
def test_a_figure_of_the_peers_beyond_its_bar_is_missed(scenes, changes, named):
    import lidar_peers
    from measuring.peers import Measured

    good = {
        "share_of_write_limit": 0.05,
        "times_as_fast_at_equal_work": {"ir_sim": 9000.0, "irsim_x": 60.0},
        "rmse_m": {"baked": 0.001, "ir_sim": 0.006, "irsim_x": 1e-6},
    }
    nobody = Measured({}, {}, {}, {}, {}, {})
    assert lidar_peers.judge(good, nobody) == []
    (missed,) = lidar_peers.judge({**good, **changes}, nobody)
    assert missed.startswith(named)


@pytest.mark.campaign
def test_the_point_clouds_of_scan_mode_baked_and_mujoco_lie_on_each_other(tmp_path):
    pytest.importorskip("mujoco")
    out = tmp_path / "clouds.png"
    code, result = asked(
        "fig4_pointcloud.py", "--scans", "12", "--without-slam", "--out", str(out)
    )
    assert (code, result["failures"]) == (0, [])
    assert result["points"] == {"exact": 8640, "baked": 8640, "mujoco": 8640}
    assert result["range_rmse_m"]["mujoco"] < 1e-5
    assert result["range_rmse_m"]["baked"] < 0.05
    assert result["cloud_rmse_m"]["baked"] < 0.01
    assert result["slam"] is None
    assert matplotlib.image.imread(out).shape[0] > 500


def test_random_scenes_keep_clear_of_the_lidar_and_differ_between_seeds(scenes):
    for shapes in scenes.SCENES.values():
        batch = scenes.random_batch(shapes, 300, 1)
        for k, shape in enumerate(batch.shapes):
            assert scenes.gap(shape, batch.poses[:, k]).min() > scenes.SPEC.range_min
        assert (
            np.hypot(*batch.poses[..., :2].reshape(-1, 2).T).max()
            <= scenes.SPEC.range_max
        )
        assert not np.allclose(batch.poses, scenes.random_batch(shapes, 300, 2).poses)


def test_the_nearest_row_is_half_a_grid_step_away_at_most(scenes):
    table = bake(scenes.SPEC, scenes.SCENES["strip"])
    batch = scenes.random_batch(scenes.SCENES["strip"], 300, 1)
    snapped = scenes.nearest_row(batch, table)
    radius = scenes.STRIP.radius
    step = scenes.SPEC.angle_increment
    distance, _ = polar(batch.poses)
    row, beam = polar(snapped.poses)
    beyond = distance < radius
    assert beyond.any()
    assert np.array_equal(snapped.poses[beyond], batch.poses[beyond])
    apart = (table.grid[0, 0] - radius) / (table.density.distances - 1)
    on_grid = (row - radius)[~beyond] / apart
    assert np.abs(on_grid - np.rint(on_grid)).max() < 1e-3
    assert np.abs(row - distance)[~beyond].max() <= 0.5001 * apart
    whole = beam[~beyond] / step
    assert np.abs(whole - np.rint(whole)).max() < 1e-6
    turn = 2.0 * np.pi / table.density.rotations
    rotation = (snapped.poses[..., 2] - beam)[~beyond] / turn
    assert np.abs(rotation - np.rint(rotation)).max() < 1e-6


def test_errors_count_no_return_as_the_greatest_range(scenes):
    beams = scenes.SPEC.beams
    nothing = np.full((1, beams), np.inf, np.float32)
    near = np.full((1, beams), 2.0, np.float32)
    rmse, area = scenes.errors([nothing], [near])
    assert rmse == pytest.approx(1.0)
    assert area == pytest.approx(np.pi * (9.0 - 4.0))


def polar(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and bearing [rad] of every obstacle."""
    return np.hypot(poses[..., 0], poses[..., 1]), np.arctan2(
        poses[..., 1], poses[..., 0]
    )


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [("coarse", "RMSE"), ("nan", "RMSE nan"), ("slow", "as fast as exact")],
)
def test_table2_fails_by_a_coarse_broken_or_slow_look_up(control, bar):
    options = ("--scans", "256", "--repeats", "2")
    assert any(bar in line for line in fails("table2_lidar.py", control, *options))


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"), [("plain", "bar a third"), ("nan", "nan m2")]
)
def test_table3_fails_by_a_plain_or_broken_look_up(control, bar):
    assert any(
        bar in line for line in fails("table3_density.py", control, "--scans", "128")
    )


@pytest.mark.campaign
def test_the_cost_of_the_exact_scanner_is_not_that_of_the_look_up():
    options = ("--most", "256", "--scans", "32", "--repeats", "3")
    missed = fails(
        "lidar_complexity.py",
        "exact",
        *options,
        "--distances",
        "10",
        "--rotations",
        "8",
    )
    assert any("with other vertices" in line for line in missed)


@pytest.mark.campaign
def test_jumps_through_a_map_give_the_ranges_of_the_walk():
    _, result = asked("map_lidar.py")
    assert len(result["rows"]) == 4
    assert not missed_but(result, "the walk's speed")


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"),
    [("shifted", "RMSE"), ("slow", "the walk's speed"), ("nan", "RMSE nan")],
)
def test_another_map_a_walk_and_a_range_that_is_none_are_found(control, bar):
    assert any(bar in line for line in fails("map_lidar.py", control))


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("control", "bar"), [("shifted", "cloud RMSE"), ("nan", "range RMSE nan")]
)
def test_a_point_cloud_from_elsewhere_is_found(control, bar, tmp_path):
    options = ("--scans", "12", "--without-slam", "--out", str(tmp_path / "clouds.png"))
    assert any(bar in line for line in fails("fig4_pointcloud.py", control, *options))
