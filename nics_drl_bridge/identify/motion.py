"""Motion as state: the body twist, taken from the pose, of robots whose state is a part of it."""

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_filter

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.signals import resample, unwrapped
from nics_drl_bridge.recording.recording import Recording, Stream
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec

WIDTHS_S = (0.07, 0.1, 0.15, 0.2, 0.3, 0.4)  # half-widths of the parabolas that give the twist
NOISE = 0.02  # share of the usual speed, and turn rate, that the noise of a twist may reach


def by_motion(spec: RobotSpec, recording: Recording) -> bool:
    """True if a state that is a part of the body twist was not measured."""
    return recording.state is None and any(v.twist for v in spec.state)


def half_width(drive: Drive) -> float:
    """Returns the half-width [s] over which poses are smoothed: the shortest that quiets them."""
    t, pose = drive.dated.t, unwrapped(drive.dated.values)
    span = float(t[-1] - t[0])
    every = span / max(len(t) - 1, 1)
    speed = np.hypot(*np.diff(pose[:, :2], axis=0).T).sum() / span
    turn = np.abs(np.diff(pose[:, 2])).sum() / span
    position, heading = drive.pose_noise or (0.0, 0.0)
    for width in WIDTHS_S:
        gain = np.sqrt(12.0 * every / (2.0 * width)) / (2.0 * width)
        if gain * position <= NOISE * speed and gain * heading <= NOISE * max(turn, speed):
            return max(width, 2.5 * every)
    return WIDTHS_S[-1]


def twists_on(drive: Drive, calibration: Calibration, grid: Array, width: float) -> Array:
    """Returns body twists (T, 3) of `base_link` at uniform times (T,) on the commands' clock."""
    t = drive.sample_t + calibration.clock_offset_s
    tracked = resample(t, unwrapped(drive.recording.pose.values), grid, 0.5 * width)
    pose = unwrapped(calibration.to_base(tracked))
    step = float(grid[1] - grid[0])
    rows = 2 * max(2, round(width / step)) + 1
    rates = savgol_filter(pose, rows, 2, deriv=1, delta=step, axis=0)
    return np.concatenate([geometry.rotate(rates[:, :2], -pose[:, 2]), rates[:, 2:]], axis=1)


def with_motion(drive: Drive, calibration: Calibration, grid: Array, width: float) -> Drive:
    """Returns a drive whose state is the twist of its poses, at uniform times (T,)."""
    twist = twists_on(drive, calibration, grid, width)
    columns = [twist[:, POSE_RATES.index(v.twist)] for v in drive.spec.state if v.twist]
    state = Stream(grid, np.stack(columns, axis=1), drive.recording.command.clock)
    return drive.part(replace(drive.recording, state=state))
