"""The example mappings, on the real recordings that they are of."""

from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.parametrize("name", SOURCES)
def test_each_example_reads_its_drives(shared_recordings, name):
    if name == "jetracer_bag":
        pytest.importorskip("rosbags", reason="needs the extra 'bags'")
    spec, drive = imported(shared_recordings, name)
    assert drive.variables == spec.variable_names
    assert drive.pose.t[-1] - drive.pose.t[0] > 40.0
    for c, variable in enumerate(spec.command):
        assert variable.min <= drive.command.values[:, c].min()
        assert drive.command.values[:, c].max() <= variable.max


def test_the_wheel_speeds_of_a_real_car_are_no_counters(shared_recordings):
    mapping = load_mapping(SHIPPED)
    counted = Value.model_validate({"from": "L_wheel.csv:0", "unit": "ticks"})
    wheels = mapping.wheels.model_copy(update={"left": counted})
    counting = mapping.model_copy(update={"wheels": wheels})
    with pytest.raises(
        RecordingError, match=r"'L_wheel.csv:0' goes up and down like a speed"
    ):
        read_recording(shared_recordings / SOURCES["xtark_folder"][0], mapping=counting)


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
    assert 0.005 < np.median(pose.sigma[:, 0]) < 0.05
