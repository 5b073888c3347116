"""Conditions under which the episodes of an evaluation are driven, alike in every place."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nics_drl_bridge.generator import SimulatorModel, open_model, save_model
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation


@dataclass(frozen=True)
class Conditions:
    """Conditions of an evaluation; None leaves the model's lidar, or randomisation and gate out."""

    lidar: str | None = None  # shipped lidar or file, instead of the model's
    # shipped one or file, which draws each episode's numbers
    randomisation: str | None = None
    # limits, shipped or a file, of a gate between policy and robot
    gate: str | None = None
    # time limit of an episode; None: that of policies, robot and world
    steps: int | None = None
    task: Mapping[str, Any] = field(
        default_factory=dict
    )  # options, instead of the policy's own
    # path/to/file.py:ClassName of a policy's task, if it is not shipped
    kind: str | None = None

    @property
    def ranges(self) -> Randomisation | None:
        """The ranges that each episode draws from. Raises ConfigError."""
        if self.randomisation is None:
            return None
        return load_randomisation(self.randomisation)

    def model(self, name: str, folder: Path) -> tuple[SimulatorModel, str]:
        """Opens a model and returns its name; with another lidar, it is saved below a folder."""
        model = open_model(name, self.lidar)
        if self.lidar is None:
            return model, name
        place = folder / "model"
        save_model(model, place)
        return open_model(place), str(place)


NO_CONDITIONS = Conditions()
