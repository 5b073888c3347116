"""Generates the models in `config/models/` anew: `make models`."""

from __future__ import annotations

from pathlib import Path

from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.files import write_text
from nics_drl_bridge.generator import generate_textbook_model
from nics_drl_bridge.robot.spec import load_robot

FOLDER = Path(__file__).resolve().parents[1] / "config" / "models"


def main() -> None:
    """Writes a model and its report for each shipped robot, without the lidar's table."""
    FOLDER.mkdir(exist_ok=True)
    for name in list_shipped("robots"):
        model = generate_textbook_model(load_robot(name))
        write_text(FOLDER / f"{name}.yaml", model.text)
        write_text(FOLDER / f"{name}.txt", model.report)


if __name__ == "__main__":
    main()
