"""Plan of the demo, and its outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Say = Callable[[str], None]


@dataclass(frozen=True)
class DemoPlan:
    """Plan of a demo.

    Attributes:
        out: output folder.
        robot: name or YAML file of the robot.
        world: name or YAML file of the world.
        recording: of a drive; None makes one with the robot's textbook kinematics.
        episodes: number of episodes, in process and again over DDS.
        policy: a policy file or a name, to drive with instead of training one.
        train_steps: environment steps of the training; None uses those of `demo.yaml`.
    """

    out: Path
    robot: str = "differential"
    world: str = "arena"
    recording: Path | None = None
    episodes: int = 5
    policy: str | None = None
    train_steps: int | None = None

    @property
    def model(self) -> Path:
        """Folder of the generated simulator."""
        return self.out / "model"

    @property
    def policy_file(self) -> Path:
        """Path of the trained policy."""
        return self.out / "policy.onnx"


@dataclass(frozen=True)
class DemoResult:
    """Outcome of the demo: successes in process and over DDS, and the path of the report."""

    in_process: int
    over_dds: int
    episodes: int
    report: Path

    def line(self) -> str:
        """The last line of the demo."""
        return (
            f"demo: in process {self.in_process}/{self.episodes}, "
            f"over DDS {self.over_dds}/{self.episodes}, report {self.report}"
        )
