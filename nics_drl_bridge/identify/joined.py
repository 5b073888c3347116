"""Joins recordings of one robot for one fit, aligning the clocks of each recording separately."""

from collections.abc import Sequence
from dataclasses import replace

from nics_drl_bridge.errors import FitError, RecordingError
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.gyro import turned_by_gyro
from nics_drl_bridge.identify.identify import estimate_timing, repair_drive, run
from nics_drl_bridge.recording.joining import join
from nics_drl_bridge.recording.recording import Recording, check
from nics_drl_bridge.robot.spec import RobotSpec


def join_recordings(recordings: Sequence[Recording], spec: RobotSpec) -> Recording:
    """Joins recordings of a robot; RecordingError for another robot, or clocks that can't align."""
    if not recordings:
        raise RecordingError("no recording was given; give one or more.")
    if len(recordings) == 1:
        return recordings[0]
    # a gyro's bias differs between drives
    turned = [turned_by_gyro(item) for item in recordings]
    offsets = [clock_offset(item, spec) for item in turned]
    joined = join(turned, offsets)
    gyros = [item.gyro for item in turned]
    return replace(
        joined, gyro=gyros[0] if all(item is not None for item in gyros) else None
    )


def clock_offset(recording: Recording, spec: RobotSpec) -> float:
    """Returns the offset [s] from the pose's clock to the commands', found from this drive."""
    if recording.pose.clock == recording.command.clock:
        return 0.0
    drive = Drive(check(recording, spec), spec)
    try:
        return run((repair_drive, estimate_timing), drive).calibration.clock_offset_s
    except FitError as error:
        fault = f"{recording.source}: its two clocks can't be aligned by this drive alone ({error})"
        raise RecordingError(
            f"{fault}; record pose and commands by one clock."
        ) from None
