"""The example mappings, on the real recordings that they are of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.config import share_folder
from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.recording.mapping import Value, load_mapping
from nics_drl_bridge.recording.readers import open_drive, read_recording

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "recordings"
SHIPPED = share_folder() / "config" / "recordings" / "xtark_folder.yaml"
SOURCES = {
    "jetracer_csv": ("jetracer_dart/free_driving_104s.csv",),
    "jetracer_bag": ("jetracer_dart/random_driving_slow_63s.bag",),
    "f110_folder": tuple(f"f110_frictionmaps/DS{k}" for k in (1, 3, 4)),
    "differential_ticks": tuple(
        f"differential_ticks/Camera_Odo_Data_0{k}.txt" for k in (1, 2)
    ),
    "xtark_folder": ("xtark_ackermann/random_drive_45s",),
}


def imported(shared_recordings, name, k=0):
    path = shared_recordings / SOURCES[name][k]
    return open_drive(path, None, EXAMPLES / f"{name}.yaml")


def test_each_example_is_of_a_real_recording():
    assert {path.stem for path in EXAMPLES.glob("*.yaml")} == set(SOURCES)


@pytest.mark.parametrize(
    ("name", "k"), [(n, k) for n, some in SOURCES.items() for k in range(len(some))]
)
def test_each_example_reads_its_drives(shared_recordings, name, k):
    if name == "jetracer_bag":
        pytest.importorskip("rosbags", reason="needs the extra 'bags'")
    spec, drive = imported(shared_recordings, name, k)
    assert drive.variables == spec.variable_names
    assert drive.pose.t[-1] - drive.pose.t[0] > 40.0
    for c, variable in enumerate(spec.command):
        assert variable.min <= drive.command.values[:, c].min()
        assert drive.command.values[:, c].max() <= variable.max


@pytest.mark.parametrize("drive", ["constant_drive_51s", "random_drive_45s"])
def test_a_folder_of_the_shipped_form_needs_no_mapping_and_is_as_its_files_say(
    shared_recordings, drive
):
    path = shared_recordings / "xtark_ackermann" / drive
    tables = {file.stem: np.loadtxt(file, delimiter=",") for file in path.glob("*.csv")}
    found = read_recording(path)
    mapped = read_recording(path, mapping=SHIPPED)
    assert (found.variables, found.robot, found.repairs) == ((), None, ())
    assert np.array_equal(found.command.values, tables["cmd"][:, :2])
    assert np.array_equal(found.command.t, tables["cmd"][:, 2])
    assert np.array_equal(found.pose.values[:, :2], tables["vrpn"][:, :2])
    assert np.array_equal(found.pose.t, tables["vrpn"][:, 7] * 1e-9)
    rows = len(found.wheels.t)  # where both sides are known
    assert len(tables["L_wheel"]) - rows <= 1
    assert np.array_equal(found.wheels.values[:, 0], tables["L_wheel"][:rows, 0])
    for name, stream in found.streams.items():
        assert np.array_equal(stream.values, mapped.streams[name].values)
        assert np.array_equal(stream.t, mapped.streams[name].t)


@pytest.mark.parametrize("drive", ["constant_drive_51s", "random_drive_45s"])
def test_the_wheel_speeds_of_a_real_car_are_no_counters(shared_recordings, drive):
    mapping = load_mapping(SHIPPED)
    counted = Value.model_validate({"from": "L_wheel.csv:0", "unit": "ticks"})
    wheels = mapping.wheels.model_copy(update={"left": counted})
    counting = mapping.model_copy(update={"wheels": wheels})
    with pytest.raises(
        RecordingError, match=r"'L_wheel.csv:0' goes up and down like a speed"
    ):
        read_recording(shared_recordings / "xtark_ackermann" / drive, mapping=counting)


@pytest.mark.parametrize("k", [0, 1])
def test_ticks_are_wheels_that_turn_the_robot_as_its_calibration_says(
    shared_recordings, k
):
    """Radius / base is 0.284 by the mean of the published radii and bases."""
    _, drive = imported(shared_recordings, "differential_ticks", k)
    t = drive.command.t
    pose = drive.pose
    turned = np.cumsum(drive.command.values[:-1] * np.diff(t)[:, None], axis=0)
    grid = np.arange(2.0, t[-1] - 1.0)
    wheels = np.diff([np.interp(grid, t[1:], each) for each in turned.T], axis=1)
    heading = np.diff(np.interp(grid, pose.t, np.unwrap(pose.values[:, 2])))
    left, right = np.linalg.lstsq(wheels.T, heading, rcond=None)[0]
    assert (-left, right) == pytest.approx((0.284, 0.284), rel=0.03)
    columns = [np.interp(grid, pose.t, each) for each in pose.values[:, :2].T]
    at = np.stack(
        [*columns, np.interp(grid, pose.t, np.unwrap(pose.values[:, 2]))], axis=1
    )
    ahead = geometry.log(geometry.between(at[:-1], at[1:]))[:, 0]
    rolled = np.linalg.lstsq(wheels.T, ahead, rcond=None)[0]
    assert rolled.sum() == pytest.approx(
        0.1676, rel=0.08
    )  # [m]: the mean published radius
    assert 0.005 < np.median(pose.sigma[:, 0]) < 0.05
