"""The parts of the benchmarks: what they draw, count and refuse."""

from __future__ import annotations

import shlex
import sys
from importlib import import_module
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from docs.test_pages import INDENTED, ROOT, check_options, text_of

from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.open_loop import select_windows
from nics_drl_bridge.identify.textbook import fit_yardstick
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.recording.readers import open_drive, read_recording
from nics_drl_bridge.recording.recording import Stream
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.randomisation import Sampler, load_randomisation

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
NAN = float("nan")


sys.path.insert(0, str(BENCHMARKS))
find_missed = import_module("bench").find_missed

# Drives of robots of other simulators


@pytest.fixture(scope="module")
def foreign():
    return import_module("measuring.foreign_robots")


@pytest.mark.parametrize("name", ["omni", "ticks"])  # encoders overflow
def test_the_csv_of_a_foreign_robot_reads_as_its_recording(foreign, tmp_path, name):
    drive = foreign.foreign_drive(foreign.ROBOTS[name], seed=1, duration_s=30.0)
    read = read_recording(tmp_path / name, mapping=drive.write(tmp_path / name))
    assert read.pose.values == pytest.approx(drive.pose.values)
    commands = drive.command
    if drive.robot.ticks_per_turn:  # of a wheel, as its speed up to the next stamp
        turns = np.diff(commands.values, axis=0) / drive.robot.ticks_per_turn
        speeds = 2.0 * np.pi * turns / np.diff(commands.t)[:, None]
        commands = Stream(commands.t[:-1], speeds)
    assert read.command.values == pytest.approx(commands.values)
    assert read.command.t == pytest.approx(commands.t)


def test_every_mapping_that_is_shown_has_its_drive():
    bars = import_module("measuring.drives")
    found = [*bars.EXAMPLES.glob("*.yaml"), *bars.SHIPPED.glob("*.yaml")]
    # One is a link to a shipped one.
    mappings = {drive.mapping for drive in bars.DRIVES.values()}
    assert mappings == {path.resolve() for path in found}


# The league


@pytest.fixture(scope="module")
def lesson(foreign, tmp_path_factory):
    """A drive of 40 s of a robot of another simulator, its textbook fitted to 26 s of it."""
    league = import_module("measuring.league")
    folder = tmp_path_factory.mktemp("lesson") / "ticks"
    mapping = foreign.foreign_drive(foreign.ROBOTS["ticks"], 3, 40.0).write(folder)
    spec, recording = open_drive(folder, None, mapping)
    drive = Drive(recording, spec)
    return league.Lesson(drive, 26.0, fit_yardstick(drive, 26.0))


@pytest.fixture
def unseen(lesson):
    return select_windows(lesson.drive, Calibration(), 26.0, 40.0, 5.0, 0.5)


@pytest.mark.campaign
@pytest.mark.parametrize(("name", "share"), [("sysid", 0.03), ("sindy", 0.2)])
def test_what_others_fit_predicts_a_drive_that_it_did_not_see(
    monkeypatch, lesson, unseen, name, share
):
    league = import_module("measuring.league")
    monkeypatch.setattr(league, "WINDOWS", 8)
    monkeypatch.setattr(league, "DEGREES", (1,))
    monkeypatch.setattr(league, "RIDGES", (1.0,))
    pytest.importorskip(league.PACKAGES[name], reason="comes with the extra test")
    ends = league.ENTRANTS[name](lesson)(unseen)
    assert league.average_errors(ends, unseen)[1] < share


def test_the_league_counts_first_places_and_those_within_five_per_cent():
    rank = import_module("measuring.league").rank_ours
    rivals = {"sysid": {"error_m": 1.0}, "shuffled_ratio": 9.0}
    drives = {
        name: {"error_m": error, "league": rivals}
        for name, error in {"first": 0.9, "near": 1.04, "third": 1.2}.items()
    }
    found = rank(drives | {"refused": {"refused": "too short"}})
    assert (found["near"], found["drives"]) == (2, 3)
    assert found["worst"] == pytest.approx(1.2)


# Scenes of the lidar


@pytest.fixture
def scenes():
    return import_module("measuring.scenes")


def test_the_nearest_row_is_half_a_grid_step_away_at_most(scenes):
    table = bake(scenes.SPEC, scenes.SCENES["strip"])
    batch = scenes.random_batch(scenes.SCENES["strip"], 300, 1)
    snapped = scenes.nearest_row(batch, table)
    distance = np.hypot(batch.poses[..., 0], batch.poses[..., 1])
    row = np.hypot(snapped.poses[..., 0], snapped.poses[..., 1])
    beam = np.arctan2(snapped.poses[..., 1], snapped.poses[..., 0])
    beyond = distance < scenes.STRIP.radius
    assert beyond.any()
    assert np.array_equal(snapped.poses[beyond], batch.poses[beyond])
    apart = (table.grid[0, 0] - scenes.STRIP.radius) / (table.density.distances - 1)
    turn = 2.0 * np.pi / table.density.rotations
    rotation = snapped.poses[..., 2] - beam
    for value, step in (
        (row - scenes.STRIP.radius, apart),
        (beam, scenes.SPEC.angle_increment),
        (rotation, turn),
    ):
        parts = value[~beyond] / step
        assert np.abs(parts - np.rint(parts)).max() < 1e-3
    assert np.abs(row - distance)[~beyond].max() <= 0.5001 * apart


def test_errors_count_no_return_as_the_greatest_range(scenes):
    nothing = np.full((1, scenes.SPEC.beams), np.inf, np.float32)
    near = np.full((1, scenes.SPEC.beams), 2.0, np.float32)
    expected = (1.0, np.pi * (9.0 - 4.0))
    assert scenes.errors([nothing], [near]) == pytest.approx(expected)


# Peers


@pytest.mark.parametrize(
    "text", ["import sys\nsys.exit('no lidar')\n", "print('{\"ranges\": [[1.0]]}')\n"]
)
def test_a_peer_that_crashes_or_ends_is_a_missed_bar_and_no_hang(
    monkeypatch, tmp_path, text
):
    peers = import_module("measuring.peers")
    broken = tmp_path / "irsim_peer.py"
    broken.write_text(text)
    monkeypatch.setattr(peers, "SCRIPT", broken)
    monkeypatch.setattr(peers, "python_with", lambda *_: sys.executable)
    found = peers.measure({}, ["ir_sim"], peers.make_scenes(1), 1)
    told = found.describe()
    (missed,) = find_missed(told, peers.set_bars(told))
    assert missed.startswith("failed: ir_sim: ir_sim failed")


# Policies


@pytest.fixture
def policies():
    return import_module("policies")


def test_a_score_is_half_for_twice_the_best_time_and_falls_with_more(policies):
    course = policies.list_courses(100)[1]
    times = [course.best_s * k for k in (1.0, 2.0, 4.0, 20.0, 2.0)]
    flags = [True, True, True, True, False]
    courses = dict.fromkeys(range(5), course)
    told = policies.score_runs(courses, 1, [flags, flags, [False] * 5], times)
    np.testing.assert_allclose(told.score, [0.5, 0.5, 0.25, 0.125, 0.0])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("navigation_differential", "replaces the world 'barn'"),
        ("shipped_jackal", "needs 5 worlds, not 3"),
    ],
)
def test_folds_that_leave_out_nothing_are_refused(policies, settings, words):
    with pytest.raises(ConfigError, match=words):
        policies.drive_folds(settings, dict.fromkeys(range(3)), 1)


def test_every_world_that_comes_with_the_package_is_driven(policies):
    assert set(policies.TRANSFER_FLOORS) == set(list_shipped("worlds"))


@pytest.mark.parametrize(
    ("places", "believed", "length", "bars"),
    [
        ((0.97, 0.95, 0.93), 0.0, 5.0, 0),
        ((0.97, 0.94, 0.97), 0.0, 5.0, 1),
        ((0.97, 0.97, 0.92), 0.0, 5.0, 1),
        ((0.97, 0.97, 0.97), 0.06, 5.0, 3),
        ((NAN, 0.97, 0.97), 0.0, 5.0, 4),
    ],
)
def test_success_has_a_floor_and_may_be_two_and_four_points_off(
    policies, places, believed, length, bars
):
    shares = dict(zip(("fast", "dds", "mujoco_dds"), places, strict=True))
    figures = {
        place: {
            "success": [share],
            "believed": [share + believed],
            "collision": [0.0],
            "length": [length],
        }
        for place, share in shares.items()
    }
    result = policies.tabulate_transfer({"jackal": {"circles": figures}})
    assert len(find_missed(result, policies.set_transfer_bars(result))) == bars


MILD = load_randomisation("mild")
DRAWN = {
    "noise": lambda d: d.faults[..., 0],
    "drop-out": lambda d: d.faults[..., 2],
    "latency": lambda d: d.delay + d.age,
    "response": lambda d: d.response,
    "drift": lambda d: d.noise[..., 2:5],
}


@pytest.mark.parametrize("name", DRAWN)
def test_a_perturbation_alone_has_the_greatest_declared_value(name):
    single_out = import_module("measuring.perturbations").single_out
    model = builtin_model("differential")
    once, twice = (single_out(MILD, name, times) for times in (1.0, 2.0))
    assert once != twice
    drawn = Sampler(once, model).draw([1, 2, 3])
    whole = Sampler(MILD, model).draw(range(200))
    assert DRAWN[name](drawn).min() >= DRAWN[name](whole).max() - 1e-12
    plain = Sampler(single_out(MILD, "footprint", 0.0), model).draw([1, 2, 3])
    for other, one in DRAWN.items():
        if other not in (name, "response"):
            assert (one(drawn) == one(plain)).all()


def test_noise_and_time_constants_do_not_fall_below_what_a_robot_has():
    single_out = import_module("measuring.perturbations").single_out
    for times, slow in ((1.0, 1.25), (2.0, 1.5)):
        response = single_out(MILD, "response", times).kinematics.response
        assert response == (slow, slow)
    assert single_out(MILD, "noise", 1.0, 0.03).lidar.noise_std == (0.03, 0.03)


@pytest.mark.parametrize("robot", ["mecanum", "jackal"])
def test_a_larger_footprint_is_the_same_outline_scaled(robot):
    model = builtin_model(robot)
    larger = import_module("measuring.perturbations").grow_footprint(model, 1.1).robot
    assert larger.footprint_radius == pytest.approx(1.1 * model.robot.footprint_radius)
    assert (larger.footprint is None) == (model.robot.footprint is None)


# The first hour


def test_the_roads_are_those_of_the_pages(tmp_path):
    first_hour = import_module("first_hour")
    for lines in first_hour.ROADS.values():
        for line in lines:
            check_options(shlex.split(line)[1:])
    text = text_of(ROOT / "docs" / "robots.md")
    (shown,) = [block for block in INDENTED.findall(text) if "name: my_robot" in block]
    (tmp_path / "page.yaml").write_text(dedent(shown))
    (tmp_path / "road.yaml").write_text(first_hour.BURGER)
    assert load_robot(tmp_path / "page.yaml") == load_robot(tmp_path / "road.yaml")


def test_an_environment_that_cant_be_installed_is_told_in_a_sentence(
    monkeypatch, tmp_path
):
    environments = import_module("measuring.environments")
    monkeypatch.setattr(environments, "CACHE", tmp_path)
    monkeypatch.setattr(environments.venv, "create", lambda *_, **__: None)
    with pytest.raises(environments.NotInstalledError, match="can't be installed"):
        environments.python_with("nothing", ("no-such-project==1.0",))
    assert not list(tmp_path.rglob(".ready"))
