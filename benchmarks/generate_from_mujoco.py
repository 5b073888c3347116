"""Robots in MuJoCo: how well, and how much faster, does the generated model predict them?

Each robot drives in MuJoCo, on real wheels with contact, and a model is made of that drive as
`nics generate` makes it: calibration, fit, pruning at the knee, refinement; the same settings for
all robots. Then the robot drives again, with other seeds and commands held for other times, and the
model predicts the pose 5 s ahead by the commands alone, from every tenth of a second. Speed is
simulated seconds per second of one thread, both sides in this run.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from bench import answer, parser_of

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.extras.mujoco.simulator import MujocoRobot, record
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.open_loop import open_loop_error
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.kernels import SERIES, make_terms, run, simulate_rollouts
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.robot.taylor import TaylorModel

CONTROLS = {
    "standing": "a model that says the robot stands",
    "slow": "MuJoCo itself in place of the model's speed",
    "nan": "one coefficient is none",
}
ERROR, WORST, FASTER = 0.05, 0.1, 1000.0
"""Bars: error over the path, on average and on the worst drive, and times MuJoCo's speed."""
ROBOTS = ("ackermann", "differential", "mecanum", "jackal")
FIRST_SEED = 201
HOLDS_S = (0.5, 1.0, 0.3, 2.0)
"""How long the unseen drives hold a command, in turn [s]."""
BATCH = 1024
HOLDS = 20
ROUNDS = 3


def errors(
    found: Identified, drives: list[Recording], spec: RobotSpec
) -> dict[str, float]:
    """Mean errors of the predictions on unseen drives, each as long as the others."""
    results = [
        open_loop_error(
            found.model, found.calibration, Drive(d, spec), 0.0, d.pose.t[-1]
        )
        for d in drives
    ]
    shares = [f.mean_position_error_m / f.mean_path_m for f in results]
    path = float(np.mean([f.mean_path_m for f in results]))
    position = float(np.mean([f.mean_position_error_m for f in results]))
    return {
        "position_error_over_path": position / path,
        "worst_drive_error_over_path": max(shares),
        "mean_position_error_m": position,
        "mean_heading_error_rad": float(
            np.mean([f.mean_heading_error_rad for f in results])
        ),
        "mean_path_m": path,
        "unseen_drives": len(drives),
        "windows": sum(f.windows for f in results),
    }


def without(model: TaylorModel, control: str | None) -> TaylorModel:
    """The model with what a control takes out."""
    if control == "standing":
        return replace(model, coefficients=1e-9 * model.coefficients)
    if control == "nan":
        return replace(model, coefficients=np.nan * model.coefficients)
    return model


def missed_of(robots: dict[str, dict[str, float]]) -> list[str]:
    """The bars that were missed."""
    missed = []
    for name, robot in robots.items():
        for key, bar in (
            ("position_error_over_path", ERROR),
            ("worst_drive_error_over_path", WORST),
        ):
            if not robot[key] <= bar:
                missed.append(f"{name}: {key} {robot[key]:.3g}, bar {bar:g}")
        if not robot["speed_up_batched"] >= FASTER:
            missed.append(
                f"{name}: {robot['speed_up_batched']:.3g} times MuJoCo's speed, bar {FASTER:g}"
            )
        if not robot["mean_path_m"] > 0.1:
            missed.append(
                f"{name}: the unseen paths are {robot['mean_path_m']:.3g} m long"
            )
    return missed


def batched_speed(model: TaylorModel, spec: RobotSpec) -> float:
    """Simulated robot-seconds per second of many robots; each gets a command every 0.1 s."""
    rng = np.random.default_rng(7)
    size = len(spec.state)
    low = spec.command_low[:, None]
    high = spec.command_high[:, None]
    commands = rng.uniform(low, high, (HOLDS, len(low), BATCH))
    terms, per_hold = make_terms(model), round(0.1 / model.dt)
    terms = terms._replace(
        coefficient=np.repeat(terms.coefficient[:, None], BATCH, axis=1)
    )
    x, dq = (
        np.ones((len(model.variables) + 1, BATCH)),
        np.zeros((len(model.dofs), BATCH)),
    )

    def drive() -> None:
        pose = np.zeros((6, BATCH))
        pose[2] = 1.0
        x[:size] = 0.0
        for command in commands:
            x[size:-1] = command
            run(pose, x, dq, terms, SERIES, model.dt, per_hold)
        require_finite(pose)

    return BATCH * HOLDS * 0.1 / best_time(drive)


def single_speed(model: TaylorModel, spec: RobotSpec, steps: int = 50_000) -> float:
    """Simulated seconds per second of one robot, many steps in one call."""
    rng = np.random.default_rng(7)
    held = rng.uniform(
        spec.command_low, spec.command_high, (1, steps // 10, len(spec.command))
    )
    commands, terms = np.repeat(held, 10, axis=1), make_terms(model)
    poses, states = (
        np.zeros((1, steps + 1, 3)),
        np.zeros((1, steps + 1, model.state_size)),
    )

    def drive() -> None:
        simulate_rollouts(poses, states, commands, terms, SERIES, model.dt)
        require_finite(poses)

    return steps * model.dt / best_time(drive)


def require_finite(poses: np.ndarray) -> None:
    """A model that diverges is fast and worthless."""
    if not np.isfinite(poses).all():
        raise BridgeError("the fitted model diverges; record a longer drive.")


def mujoco_speed(robot: MujocoRobot, seconds: float) -> float:
    """Simulated seconds per second, driven at 10 Hz."""
    rng = np.random.default_rng(7)
    spec = robot.spec
    commands = rng.uniform(
        spec.command_low, spec.command_high, (round(10 * seconds), len(spec.command))
    )

    def drive() -> None:
        for command in commands:
            robot.step(command, 0.1)

    robot.reset(np.zeros(3))
    return seconds / best_time(drive)


def best_time(work: Callable[[], None]) -> float:
    """The shortest of some runs [s], since others use the machine too; the first is not timed."""
    work()
    times = []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def measure(name: str, given: argparse.Namespace) -> dict[str, Any]:
    """All figures of one robot."""
    spec = load_robot(name)
    robot = MujocoRobot(spec)
    recording = record(robot, np.random.default_rng(given.seed), given.train)
    drives = [
        record(
            robot,
            np.random.default_rng(FIRST_SEED + n),
            given.unseen,
            hold=HOLDS_S[n % len(HOLDS_S)],
        )
        for n in range(given.drives)
    ]
    begin = time.perf_counter()
    found = identify(recording, spec, alpha="auto")
    seconds = time.perf_counter() - begin
    model = without(found.model, given.control)
    found = replace(found, model=model)
    physics = mujoco_speed(robot, 4.0)
    if given.control == "slow":
        batched = single = physics
    elif given.control == "nan":
        batched = single = float("nan")  # it diverges, which is refused
    else:
        batched = batched_speed(model, spec)
        single = single_speed(model, spec)
    return {
        **errors(found, drives, spec),
        "speed_up_batched": batched / physics,
        "speed_up_single": single / physics,
        "mujoco_seconds_per_second": physics,
        "model_seconds_per_second_batched": batched,
        "model_seconds_per_second_single": single,
        "terms_kept": model.terms_kept,
        "seconds_to_identify": seconds,
    }


def main() -> int:
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument(
        "--train", type=float, default=90.0, help="length of the drive to learn [s]"
    )
    parser.add_argument(
        "--unseen", type=float, default=20.0, help="length of each unseen drive [s]"
    )
    parser.add_argument("--drives", type=int, default=8, help="number of unseen drives")
    parser.add_argument("--seed", type=int, default=0, help="of the drive to learn")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    given = parser.parse_args()
    if given.drives < 1:
        parser.error(f"--drives {given.drives}: give 1 or more unseen drives.")
    try:
        robots = {name: measure(name, given) for name in given.robots}
    except BridgeError as error:
        print(error, file=sys.stderr)
        return 2
    answer({"robots": robots}, missed_of(robots), given.json)


if __name__ == "__main__":
    sys.exit(main())
