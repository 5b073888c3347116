"""Open-loop error on unseen data of a real car.

Fits a model to the first part of a drive, then predicts the pose 5 s ahead by the commands
alone, from each measured pose of the rest, and compares the ends. Of the rest nothing is used
but the pose at each window's start.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from nics_drl_bridge.calibration.identify import Identified, identify
from nics_drl_bridge.calibration.open_loop import HORIZON_S
from nics_drl_bridge.errors import BridgeError, RecordingError
from nics_drl_bridge.kinematics.readers import read_recording
from nics_drl_bridge.kinematics.spec import load_robot

RECORDINGS = Path(__file__).resolve().parents[2] / "shared" / "recordings"
DEFAULT = RECORDINGS / "xtark_ackermann" / "random_drive_45s"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--recording", type=Path, default=DEFAULT, help="folder or .npz")
    parser.add_argument(
        "--train-until", type=float, help="end of the training part, seconds from the start"
    )
    parser.add_argument("--robot", default="ackermann", help="name or YAML file of the robot")
    return parser.parse_args()


def results(found: Identified, recording: Path, seconds: float) -> dict[str, object]:
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


def table(result: dict[str, object]) -> str:
    rows = [f"{name:<26} {value:.4g}" for name, value in result.items() if isinstance(value, float)]
    rows += [f"{name:<26} {result[name]}" for name in ("windows", "terms_kept", "wheels_swapped")]
    lists = [f"  {line}" for name in ("equations", "notes") for line in result[name]]  # type: ignore[attr-defined]
    return "\n".join([f"recording {result['recording']}", *rows, "model and notes", *lists])


def main() -> int:
    options = arguments()
    try:
        recording, robot = read_recording(options.recording), load_robot(options.robot)
        begin = time.perf_counter()
        found = identify(recording, robot, train_until=options.train_until)
        result = results(found, options.recording, time.perf_counter() - begin)
    except BridgeError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(result) if options.json else table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
