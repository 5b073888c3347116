"""Plan a drive through a robot's full range of motion in a circle, and record a textbook robot."""

from pathlib import Path

import numpy as np

from nics_drl_bridge import load_robot, save_recording
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.excite import DrivePlan
from nics_drl_bridge.report.pictures import drive_picture


def main() -> None:
    robot = load_robot("ackermann")
    # like `nics record --preview`
    pattern = DrivePlan(robot, bound=2.0, duration=60.0).preview()
    print("\n".join(pattern.describe()))
    Path("record_drive.png").write_bytes(drive_picture(pattern, robot))

    # `nics record` drives a real robot
    recording = textbook.record(robot, np.random.default_rng(0))
    save_recording(recording, "drive.npz")
    print(f"drive.npz holds {len(recording.pose.t)} poses")


if __name__ == "__main__":
    main()
