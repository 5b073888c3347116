"""Fit and prune a Taylor model (Eq. 1, 2) of a recording, and predict data that the fit never saw.

The picture `fit_model.png` compares predictions over 5 s with the measurements.
"""

from pathlib import Path

import numpy as np

from nics_drl_bridge.identify.identify import identify
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.report.fit_pictures import draw_held_out_paths
from nics_drl_bridge.robot.spec import load_robot


def main() -> None:
    robot = load_robot("differential")
    # or read_recording(path)
    recording = textbook.record(robot, np.random.default_rng(0))
    found = identify(recording, robot)
    print("\n".join(found.model.equations()))
    Path("fit_model.png").write_bytes(draw_held_out_paths(found.trial))


if __name__ == "__main__":
    main()
