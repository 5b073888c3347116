"""Conditions of the episodes of an evaluation, the same in every place."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nics_drl_bridge.generator import SimulatorModel, open_model, save_model
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation


@dataclass(frozen=True)
class Conditions:
    """Conditions of an evaluation; by default the model's lidar, no randomisation and no gate."""

    lidar: str | None = None  # shipped lidar or YAML file; None: the model's
    # shipped randomisation or YAML file, drawn for each episode
    randomisation: str | None = None
    # limits of a gate between policy and robot: shipped, or a YAML file
    gate: str | None = None
    # time limit of an episode [steps]; None: from policies, robot and world
    steps: int | None = None
    # overrides of the policy's task options
    task: Mapping[str, Any] = field(default_factory=dict)
    # path/to/file.py:ClassName of the policy's task, if it is not shipped
    kind: str | None = None

    @property
    def ranges(self) -> Randomisation | None:
        """Ranges that each episode draws from. Raises ConfigError."""
        if self.randomisation is None:
            return None
        return load_randomisation(self.randomisation)

    def model(self, name: str, folder: Path) -> tuple[SimulatorModel, str]:
        """Opens a model; returns it and its name. Saves it below a folder if the lidar differs."""
        model = open_model(name, self.lidar)
        if self.lidar is None:
            return model, name
        place = folder / "model"
        save_model(model, place)
        return open_model(place), str(place)


NO_CONDITIONS = Conditions()
