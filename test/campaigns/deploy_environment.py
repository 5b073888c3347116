"""Does a policy file drive where nothing of training is installed?

Makes a virtual environment with the package, its extra `deploy` and ROS 2, and starts `policy_node`
there with a policy file. A stand-in for the robot, in the same environment, publishes scans and
odometry and waits for commands. Where ROS 2 is installed it is used, otherwise its wheels.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from campaign import FOLDER, ROOT, Given, Result, run_campaign
from measuring.environments import inherit_for_newcomer

ROBOT = "differential"
FORBIDDEN = ("torch", "stable_baselines3", "mujoco", "tensorboard")
STAND_IN = FOLDER / "parts" / "deployed_policy.py"
INSTALL_S = 900
DRIVE_S = 900


def export(folder: Path) -> tuple[Path, Path]:
    """A model's folder and a policy file with weights at random, made right here."""
    import torch

    from nics_drl_bridge.env.registry import make_task
    from nics_drl_bridge.generator import open_model, save_model
    from nics_drl_bridge.policy.train.export import export_policy

    torch.manual_seed(0)
    model = open_model(ROBOT)
    task = make_task("navigation", model, {"scan": "around"})
    size = task.observation_space.shape[0]
    layers = [torch.nn.Linear(size, 64), torch.nn.Tanh(), torch.nn.Linear(64, 2)]
    save_model(model, folder / "model")
    export_policy(torch.nn.Sequential(*layers), task, model, folder / "policy.onnx")
    return folder / "model", folder / "policy.onnx"


def installed(folder: Path) -> Path:
    """The Python of a new environment with the package and `deploy`."""
    subprocess.run(
        [sys.executable, "-m", "venv", str(folder)],
        check=True,
        env=inherit_for_newcomer(),
    )
    source = folder / "source"
    kept = shutil.ignore_patterns(".git", ".venv", "__pycache__", "build", "*.egg-info")
    shutil.copytree(ROOT, source, ignore=kept)
    python = folder / "bin" / "python"
    extras = "deploy" if "ROS_DISTRO" in os.environ else "deploy,ros"
    command = [
        str(python),
        "-m",
        "pip",
        "install",
        "-q",
        "-c",
        str(ROOT / "constraints.txt"),
    ]
    command.append(f"{source}[{extras}]")
    subprocess.run(command, check=True, env=inherit_for_newcomer(), timeout=INSTALL_S)
    return python


def present(python: Path) -> list[str]:
    """Which of the forbidden modules an environment has."""
    code = f"import importlib.util as u; print(*[n for n in {FORBIDDEN!r} if u.find_spec(n)])"
    done = subprocess.run(
        [str(python), "-c", code],
        env=inherit_for_newcomer(),
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def measure(given: Given) -> Result:
    """Makes the environment, drives in it, and removes it; controls drive in this one."""
    here = given.here or given.control is not None
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        model, policy = export(folder)
        if given.control == "no_policy":
            policy.write_bytes(policy.read_bytes()[:100])
        began = time.monotonic()
        python = Path(sys.executable) if here else installed(folder / "environment")
        install_s = time.monotonic() - began
        found = present(python)
        done = subprocess.run(
            [str(python), str(STAND_IN), str(model), str(policy)],
            env=inherit_for_newcomer() | ({"PYTHONPATH": str(ROOT)} if here else {}),
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=DRIVE_S,
        )
    told = {"install_s": round(install_s, 1), "training_modules": found}
    if done.returncode != 0:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        return {**told, "commands": 0, "said": said[-1] if said else ""}
    return {**told, **json.loads(done.stdout.splitlines()[-1])}


def judge(found: Result) -> list[str]:
    """A sentence for each bar that was missed."""
    said = []
    if not found["commands"] > 0:
        said.append(f"policy_node sent no command: {found.get('said', '')}")
    if found["training_modules"]:
        said.append(f"of training there is {', '.join(found['training_modules'])}")
    return said


if __name__ == "__main__":
    run_campaign(measure, judge, {"here": (False, "in this environment")})
