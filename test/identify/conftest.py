from __future__ import annotations

from pathlib import Path

import pytest

from nics_drl_bridge.robot.spec import RobotSpec, load_robot

RECORDINGS = (
    Path(__file__).resolve().parents[3] / "shared" / "recordings" / "xtark_ackermann"
)


@pytest.fixture(scope="session")
def car() -> RobotSpec:
    return load_robot("ackermann")


@pytest.fixture(scope="session")
def differential() -> RobotSpec:
    return load_robot("differential")


@pytest.fixture(scope="session")
def mecanum() -> RobotSpec:
    return load_robot("mecanum")


@pytest.fixture(scope="session")
def real_drives() -> Path:
    if not RECORDINGS.is_dir():
        pytest.skip(f"the recordings of the real car are not at {RECORDINGS}")
    return RECORDINGS
