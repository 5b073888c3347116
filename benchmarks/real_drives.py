"""Real drives of others, as they are, and robots of other simulators: judged against a yardstick.

Each drive goes in by its mapping alone. A model is made of the first two thirds, and predicts the
poses of the last third 5 s ahead by the commands, from every tenth of a second. Beside it, on the
same windows: a robot that keeps its twist, and its textbook fitted to the same two thirds. Of
robots in simulators of their own, all else that is found is compared with what is true.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench import answer, parser_of
from measuring.drive_bars import (
    DRIVES,
    RECORDINGS,
    SEGMENT_S,
    SEGMENTED,
    missed_of,
)
from measuring.foreign_robots import ROBOTS, foreign_drive
from measuring.truths import Truth, compared

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.open_loop import (
    HORIZON_S,
    SPACING_S,
    Windows,
    predict,
    windows,
)
from nics_drl_bridge.identify.yardstick import fit_yardstick, kept_twist
from nics_drl_bridge.recording.readers import open_drive
from nics_drl_bridge.recording.recording import Recording

CONTROLS = {
    "standing": "a model that says the robot stands",
    "shuffled": "commands of another time",
}
SEED = 11  # of the drives of the own robots
OTHER_TIME = 0.37  # share of the drive by which the commands of the control are moved


def arguments() -> argparse.Namespace:
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--recordings", type=Path, default=RECORDINGS, help="folder of the drives"
    )
    names = [*DRIVES, *ROBOTS]
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, help="by name"
    )
    return parser.parse_args()


def under(control: str | None, recording: Recording) -> Recording:
    """Returns the recording with what a control takes out of it."""
    if control != "shuffled":
        return recording
    command = recording.command
    values = np.roll(command.values, round(OTHER_TIME * len(command.t)), axis=0)
    return replace(recording, command=replace(command, values=values))


def judged(
    found: Identified, recording: Recording, control: str | None
) -> dict[str, Any]:
    """Returns the errors of a model, and of its yardsticks, on what it has not seen."""
    # The trial: what is written was fitted to the last third, too. The yardsticks know the commands
    # that were given, whatever a control made of them.
    found = found.trial
    drive = found.drive
    calibration = found.calibration
    until = found.train_until_s
    chosen = windows(drive, calibration, until, drive.duration_s, HORIZON_S, SPACING_S)
    ends = (
        chosen.start
        if control == "standing"
        else predict(found.model, calibration, drive, chosen)
    )
    given = drive.part(replace(drive.recording, command=recording.command))
    yardstick = fit_yardstick(given, until, calibration.clock_offset_s)
    error, share, heading = off(ends, chosen)
    coverage = {
        f"{at.horizon_s:g}": at.coverage
        for at in found.judgement
        if at.coverage is not None
    }
    return {
        "error_m": error,
        "share_of_path": share,
        "heading_error_rad": heading,
        "yardstick_share": off(yardstick.predict(given, chosen), chosen)[1],
        "constant_twist_share": off(kept_twist(drive, chosen), chosen)[1],
        "coverage_95": coverage.get(f"{HORIZON_S:g}", float("nan")),
        "coverages_95": coverage,
        "errors_m": {
            f"{at.horizon_s:g}": at.model.position_m for at in found.judgement
        },
        "path_m": float(chosen.path.mean()),
        "windows": len(chosen.start_t),
    }


def off(ends: Array, chosen: Windows) -> tuple[float, float, float]:
    """Returns mean errors: of the position [m], as a share of the path, of the heading [rad]."""
    apart = ends - chosen.end
    error = float(np.hypot(apart[:, 0], apart[:, 1]).mean())
    heading = float(np.abs(geometry.wrap_angle(apart[:, 2])).mean())
    return error, error / float(chosen.path.mean()), heading


def figures(
    source: Path, mapping: Path, truth: Truth, control: str | None
) -> dict[str, Any]:
    """Returns a drive's figures, or the sentence that refuses it."""
    begin = time.perf_counter()
    lines = [
        line
        for line in mapping.read_text("utf-8").splitlines()
        if line[:1] not in ("#", "")
    ]
    told: dict[str, Any] = {"lines_of_mapping": len(lines)}
    try:
        spec, recording = open_drive(source, None, mapping)
        found = identify(under(control, recording), spec, alpha="auto")
        told |= judged(found, recording, control)
    except BridgeError as error:
        return told | {"refused": str(error)}
    except Exception as error:  # noqa: BLE001 - one drive's crash is a bar missed, not the end
        return told | {"crashed": f"{type(error).__name__}: {error}"}
    seconds = time.perf_counter() - begin
    return told | {
        "truths": compared(found, truth),
        "equations": found.model.equations(),
        "notes": list(found.notes),
        "seconds": seconds,
    }


def left_out(source: Path, mapping: Path, control: str | None) -> dict[str, Any]:
    """Returns mean errors on segments of a drive, each predicted by a model of all others."""
    spec, recording = open_drive(source, None, mapping)
    recording = under(control, recording)
    since = recording.pose.t - recording.pose.t[0]
    errors = []
    paths = []
    for start in np.arange(0.0, since[-1] - SEGMENT_S, SEGMENT_S):
        others = recording.pose.rows((since < start) | (since >= start + SEGMENT_S))
        found = identify(
            replace(recording, pose=others),
            spec,
            alpha="auto",
            train_until=2.0 * since[-1],
        )
        drive = Drive(recording, spec)
        chosen = windows(
            drive, found.calibration, start, start + SEGMENT_S, HORIZON_S, SPACING_S
        )
        if not len(chosen.start_t):  # its clocks were taken to share nothing
            errors.append((np.inf,) * 3)
            continue
        ends = predict(found.model, found.calibration, drive, chosen)
        paths.append(float(chosen.path.mean()))
        errors.append(off(chosen.start if control == "standing" else ends, chosen))
    error, share, heading = (float(mean) for mean in np.mean(errors, axis=0))
    return {
        "error_m": error,
        "share_of_path": share,
        "heading_error_rad": heading,
        "errors_m": [each[0] for each in errors],
        "path_m": float(np.mean(paths)) if paths else 0.0,
    }


def main() -> int:
    options = arguments()
    real = [name for name in options.only if name in DRIVES]
    if real and not options.recordings.is_dir():
        place = options.recordings
        print(
            f"{place}: no such folder of recordings; give --recordings.",
            file=sys.stderr,
        )
        return 2
    result: dict[str, Any] = {"drives": {}, "left_out": {}, "own_robots": {}}
    for name in real:
        given = DRIVES[name]
        control = options.control
        source = options.recordings / given.source
        result["drives"][name] = figures(source, given.mapping, given.truth, control)
        if name == SEGMENTED:
            result["left_out"][name] = left_out(source, given.mapping, control)
    with tempfile.TemporaryDirectory() as folder:
        for name in (n for n in options.only if n in ROBOTS):
            source = Path(folder) / name
            mapping = foreign_drive(ROBOTS[name], SEED).write(source)
            truth = ROBOTS[name].truth
            result["own_robots"][name] = figures(
                source, mapping, truth, options.control
            )
    answer(result, missed_of(result), options.json)


if __name__ == "__main__":
    sys.exit(main())
