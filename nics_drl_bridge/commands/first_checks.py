"""Checks of a command's names and files, before anything slow is loaded."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

from nics_drl_bridge.errors import ConfigError

if TYPE_CHECKING:
    from nics_drl_bridge.recording.excite import DrivePlan

# Limit of numpy's global generator, which Stable-Baselines3 uses.
GREATEST_TRAINING_SEED = 2**32 - 1


def check_writable(path: Path) -> None:
    """Raises ConfigError unless a file can be written at a path; leaves no file."""
    from nics_drl_bridge.files import check_above

    check_above(path)
    above = next(parent for parent in path.resolve().parents if parent.exists())
    try:
        with TemporaryFile(dir=above):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(
            f"--out {path}: {above}: {reason}; choose another place."
        ) from None


def check_suffix(option: str, file: Path, *suffixes: str) -> None:
    """Raises ConfigError unless a file to write has the first suffix, or one of the others."""
    if file.suffix not in suffixes:
        raise ConfigError(f"{option} {file}: must end in {suffixes[0]}.")


def check_task(name: str) -> None:
    """Raises ConfigError unless a task is shipped or exists in the user's own file."""
    file = Path(name.rpartition(":")[0] or name)
    if file.suffix == ".py" and not file.is_file():
        raise ConfigError(
            f"task {str(file)!r}: no such file; give path/to/file.py:ClassName."
        )
    from nics_drl_bridge.env.registry import find_task_class

    find_task_class(name, {})


def check_training(
    task: str,
    robot: str | None,
    worlds: Sequence[str],
    seeds: Sequence[int],
    out: Path | None,
) -> None:
    """Raises ConfigError or ModelError for the first name, seed or place that can't be used."""
    from nics_drl_bridge.seeds import check_seeds

    check_seeds(seeds, GREATEST_TRAINING_SEED)
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"seeds {list(seeds)}: give one or more, without duplicates.")
    if out is not None:
        if out.exists() and not out.is_dir():
            raise ConfigError(
                f"--out {out}: is a file, not a folder; give the name of a folder."
            )
        check_writable(out / "settings.yaml")
    if robot is not None:
        from nics_drl_bridge.generator import open_model

        open_model(robot)
    if task != "navigation":
        check_task(task)
    if worlds:
        from nics_drl_bridge.sim.world_set import load_worlds

        for world in worlds:
            load_worlds(world)


def check_settings(task: str, settings: str | None, changes: dict[str, Any]) -> None:
    """Raises ConfigError unless training settings can be read and accept the changes."""
    from nics_drl_bridge.config import find_config

    if settings is not None:
        file = find_config(settings, "training")
        if not file.is_file():
            raise ConfigError(f"--settings {file}: no such file; check the path.")
    from nics_drl_bridge.policy.train.settings import chosen_settings

    check_task(chosen_settings(task, settings, changes).task)


def check_drive(parameters: dict[str, Any]) -> "DrivePlan":
    """Returns the drive of `nics record`. Raises BridgeError if it could not be driven."""
    from nics_drl_bridge.recording.excite import DrivePlan
    from nics_drl_bridge.recording.topic_roles import load_topic_roles
    from nics_drl_bridge.recording.write import check_out
    from nics_drl_bridge.robot.spec import load_robot

    check_writable(check_out(Path(parameters["out"])))
    load_topic_roles(parameters["topics"] or None)
    options = {
        name: parameters[name] for name in ("bound", "duration", "speed", "seed")
    }
    return DrivePlan(load_robot(parameters["robot"]), **options)
