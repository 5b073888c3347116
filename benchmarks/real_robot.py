"""Open-loop error on unseen data of a real car.

Fits a model to the first part of a drive, then predicts the pose 5 s ahead by the commands
alone, from each measured pose of the rest, and compares the ends. Of the rest nothing is used
but the pose at each window's start.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring.verdict import answer, parser_of

from nics_drl_bridge.errors import BridgeError, RecordingError
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.open_loop import HORIZON_S, open_loop_error
from nics_drl_bridge.recording.readers import read_recording
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

CONTROLS = {
    "standing": "a model that says the robot stands",
    "shuffled": "a model whose terms have changed places",
}
ERROR_OVER_PATH = 0.05
"""Bar: mean error after 5 s over the mean path; measured 0.011."""
RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "recordings"
DEFAULT = RECORDINGS / "xtark_ackermann" / "random_drive_45s"


def arguments() -> argparse.Namespace:
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--recording", type=Path, default=DEFAULT, help="folder or .npz"
    )
    parser.add_argument(
        "--train-until",
        type=float,
        help="end of the training part, seconds from the start",
    )
    parser.add_argument(
        "--robot", default="ackermann", help="name or YAML file of the robot"
    )
    return parser.parse_args()


def under(
    control: str | None, found: Identified, recording: Recording, robot: RobotSpec
) -> Identified:
    """What was found, with what a control takes out of the model."""
    coefficients = found.model.coefficients
    if control is None:
        return found
    if control == "standing":
        coefficients = 1e-9 * coefficients
    else:
        coefficients = np.roll(coefficients, 1, axis=0)
    model = replace(found.model, coefficients=coefficients)
    held_out = open_loop_error(
        model,
        found.calibration,
        Drive(recording, robot),
        found.train_until_s,
        float(recording.pose.t[-1]),
    )
    return replace(found, model=model, held_out=held_out)


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    share = result["mean_position_error_m"] / result["mean_path_m"]
    if not share <= ERROR_OVER_PATH:
        missed.append(
            f"the pose is off by {result['mean_position_error_m']:.3f} m over a path of "
            f"{result['mean_path_m']:.2f} m, bar {ERROR_OVER_PATH:g} of it"
        )
    if not result["windows"] > 10:
        missed.append(f"{result['windows']} windows, bar more than 10")
    return missed


def results(found: Identified, recording: Path, seconds: float) -> dict[str, Any]:
    if found.held_out is None:
        raise RecordingError(
            f"{recording}: less than {HORIZON_S:g} s are left after {found.train_until_s:.1f} s; "
            "give a smaller --train-until or a longer drive."
        )
    calibration = found.calibration
    return {
        **asdict(found.held_out),
        "recording": recording.name,
        "train_until_s": found.train_until_s,
        "terms_kept": found.model.terms_kept,
        "equations": found.model.equations(),
        "clock_offset_s": calibration.clock_offset_s,
        "command_latency_s": calibration.command_latency_s,
        "rotation_rad": calibration.rotation_rad,
        "wheels_swapped": calibration.wheels_swapped,
        "seconds_to_fit": seconds,
        "notes": list(found.notes),
    }


def table(result: dict[str, Any]) -> str:
    rows = [
        f"{name:<26} {value:.4g}"
        for name, value in result.items()
        if isinstance(value, float)
    ]
    rows += [
        f"{name:<26} {result[name]}"
        for name in ("windows", "terms_kept", "wheels_swapped")
    ]
    lists = [f"  {line}" for name in ("equations", "notes") for line in result[name]]
    return "\n".join(
        [f"recording {result['recording']}", *rows, "model and notes", *lists]
    )


def main() -> int:
    options = arguments()
    try:
        recording, robot = read_recording(options.recording), load_robot(options.robot)
        begin = time.perf_counter()
        found = identify(recording, robot, train_until=options.train_until).trial
        seconds = time.perf_counter() - begin
        found = under(options.control, found, recording, robot)
        result = results(found, options.recording, seconds)
    except BridgeError as error:
        print(error, file=sys.stderr)
        return 2
    answer(result, missed_of(result), table(result) + "\n", options.json)


if __name__ == "__main__":
    sys.exit(main())
