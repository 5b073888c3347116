"""Fidelity: models on real drives and on robots of other engines, and the estimator's errors.

python benchmarks/fidelity.py real_drives | generate_from_mujoco | estimator
"""

import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from bench import (
    Bar,
    Bars,
    Benchmark,
    Control,
    Given,
    Result,
    at_least,
    at_most,
    run_benchmark,
    some_of,
)
from measuring.drives import (
    DRIVES,
    RECORDINGS,
    SEGMENT_S,
    SEGMENTED,
    set_drive_bars,
)
from measuring.foreign_robots import ROBOTS, foreign_drive
from measuring.league import Lesson, average_errors, hold_league, rank_ours
from measuring.rates import measure_speeds

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.identify import Identified, identify
from nics_drl_bridge.identify.open_loop import (
    HORIZON_S,
    SPACING_S,
    measure_open_loop_error,
    predict,
    select_windows,
)
from nics_drl_bridge.identify.textbook import fit_yardstick, predict_kept_twist
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.measurement import ODOM
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.recording.readers import open_drive
from nics_drl_bridge.recording.recording import Recording
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

# Real drives

SEEDS = (11, 12, 13)  # of the drives of an own robot
AT_ONCE = 2


def judge_model(found: Identified, control: str | None, league: bool = False) -> Result:
    """Returns the errors of a model, and of its yardsticks, on what it has not seen."""
    # The trial: what is written was fitted to the last third, too.
    found = found.trial
    drive = found.drive
    calibration = found.calibration
    until = found.train_until_s
    chosen = select_windows(
        drive, calibration, until, drive.duration_s, HORIZON_S, SPACING_S
    )
    ends = predict(found.model, calibration, drive, chosen)
    if control == "standing":
        ends = chosen.start
    yardstick = fit_yardstick(drive, until, calibration.clock_offset_s)
    error, share, heading = average_errors(ends, chosen)
    told: Result = {
        "error_m": error,
        "share_of_path": share,
        "heading_error_rad": heading,
        "yardstick_share": average_errors(yardstick.predict(drive, chosen), chosen)[1],
        "constant_twist_share": average_errors(
            predict_kept_twist(drive, chosen), chosen
        )[1],
        "path_m": float(chosen.path.mean()),
    }
    told |= {f"coverage_{at.horizon_s:g}": at.coverage for at in found.judgement}
    if league:
        lesson = Lesson(drive, until, yardstick)
        told["league"] = hold_league(lesson, chosen, control == "ordered")
    return told


def measure_drive(
    source: Path, mapping: Path, control: str | None, league: bool = False
) -> Result:
    """Returns a drive's figures, or the sentence that refuses it."""
    told: Result = {}
    try:
        spec, recording = open_drive(source, None, mapping)
        begin = time.process_time()
        found = identify(recording, spec, alpha="auto")
        told["seconds"] = time.process_time() - begin
        told |= judge_model(found, control, league)
    except BridgeError as error:
        return told | {"refused": str(error)}
    except Exception as error:  # noqa: BLE001 - one drive's crash is a bar missed, not the end
        return told | {"crashed": f"{type(error).__name__}: {error}"}
    return told


def measure_own_robot(name: str, folder: Path, control: str | None) -> Result:
    """Returns mean figures of a robot of another simulator, over drives of several seeds."""
    drives = []
    for seed in SEEDS:
        source = folder / f"{name}_{seed}"
        mapping = foreign_drive(ROBOTS[name], seed).write(source)
        told = measure_drive(source, mapping, control)
        if "error_m" not in told:
            return told  # why not
        drives.append(told)
    return average(drives)


def average(results: Iterable[Result]) -> Result:
    """Returns the mean of each figure over the results that have it."""
    lists: dict[str, list[float]] = {}
    for result in results:
        for name, figure in result.items():
            if isinstance(figure, float):
                lists.setdefault(name, []).append(figure)
    return {name: float(np.mean(figures)) for name, figures in lists.items()}


def leave_out(source: Path, mapping: Path, control: str | None) -> Result:
    """Returns mean errors on segments of a drive, each predicted by a model of all others."""
    spec, recording = open_drive(source, None, mapping)
    drive = Drive(recording, spec)
    since = recording.pose.t - recording.pose.t[0]
    errors = []
    paths = []
    for start in np.arange(0.0, since[-1] - SEGMENT_S, SEGMENT_S):
        end = start + SEGMENT_S
        others = recording.pose.rows((since < start) | (since >= end))
        rest = replace(recording, pose=others)
        found = identify(rest, spec, alpha="auto", train_until=2.0 * since[-1])
        calibration = found.calibration
        chosen = select_windows(drive, calibration, start, end, HORIZON_S, SPACING_S)
        if not len(chosen.start_t):  # its clocks were taken to share nothing
            errors.append((np.inf,) * 3)
            continue
        ends = predict(found.model, calibration, drive, chosen)
        if control == "standing":
            ends = chosen.start
        paths.append(float(chosen.path.mean()))
        errors.append(average_errors(ends, chosen))
    error, share, heading = (float(mean) for mean in np.mean(errors, axis=0))
    return {
        "error_m": error,
        "share_of_path": share,
        "heading_error_rad": heading,
        "path_m": float(np.mean(paths)) if paths else 0.0,
    }


def measure_real_drives(given: Given) -> Result:
    """How far off is a model on real drives of others, and on robots of other simulators?

    Each drive goes in by its mapping alone. A model is made of the first two thirds, and predicts
    the poses of the last third 5 s ahead by the commands, from every tenth of a second. Beside it,
    on the same windows: a robot that keeps its twist, and its textbook fitted to the same two
    thirds. With `--league` also what others fit to these, and the robot's description as it is.
    Two drives are measured at a time.
    """
    control = given.control
    result: Result = {"drives": {}, "left_out": {}, "own_robots": {}}
    real = [name for name in given.only if name in DRIVES]
    if real and not given.recordings.is_dir():
        place = given.recordings
        raise SystemExit(f"{place}: no such folder of recordings; give --recordings.")
    spawn = get_context("spawn")
    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(AT_ONCE, mp_context=spawn) as pool,
    ):
        jobs = {}
        for name in real:
            about = (
                given.recordings / DRIVES[name].source,
                DRIVES[name].mapping,
                control,
            )
            jobs["drives", name] = pool.submit(measure_drive, *about, given.league)
            if name == SEGMENTED:
                jobs["left_out", name] = pool.submit(leave_out, *about)
        for name in (each for each in given.only if each in ROBOTS):
            job = pool.submit(measure_own_robot, name, Path(folder), control)
            jobs["own_robots", name] = job
        for (kind, name), job in jobs.items():
            result[kind][name] = job.result()
    result["league"] = rank_ours(result["drives"])
    result["together"] = average(
        [*result["drives"].values(), *result["own_robots"].values()]
    )
    return result


# Robots in MuJoCo

MUJOCO_ROBOTS = ("ackermann", "differential", "mecanum", "jackal")
MUJOCO_BARS = {
    "position_error_over_path": at_most(0.05),
    "worst_drive_error_over_path": at_most(0.1),
    "speed_up_batched": at_least(1000.0, "times MuJoCo's speed"),
    "mean_path_m": at_least(0.1),
}
FIRST_SEED = 201
HOLDS_S = (0.5, 1.0, 0.3, 2.0)  # how long the unseen drives hold a command, in turn
PHYSICS_S = 4.0


def average_drives(
    found: Identified, drives: list[Recording], spec: RobotSpec
) -> dict[str, float]:
    """Returns mean errors of the predictions on unseen drives, each as long as the others."""
    results = [
        measure_open_loop_error(
            found.model, found.calibration, Drive(d, spec), 0.0, d.pose.t[-1]
        )
        for d in drives
    ]
    shares = [each.mean_position_error_m / each.mean_path_m for each in results]
    path = float(np.mean([each.mean_path_m for each in results]))
    position = float(np.mean([each.mean_position_error_m for each in results]))
    return {
        "position_error_over_path": position / path,
        "worst_drive_error_over_path": max(shares),
        "mean_path_m": path,
    }


def measure_mujoco(given: Given) -> Result:
    """How well, and how much faster, does the generated model predict robots in MuJoCo?

    Each robot drives in MuJoCo, on real wheels with contact, and a model is made of that drive as
    `nics generate` makes it: calibration, fit, pruning at the knee, refinement; the same settings
    for all robots. Then the robot drives again, with other seeds and commands held for other
    times, and the model predicts the pose 5 s ahead by the commands alone, from every tenth of a
    second. Speed is simulated seconds per second of one thread, both sides in this run.
    """
    from nics_drl_bridge.extras.mujoco.simulator import MujocoRobot
    from nics_drl_bridge.extras.physics.simulator import record

    robots = {}
    for name in given.robots:
        spec = load_robot(name)
        robot = MujocoRobot(spec)
        recording = record(robot, np.random.default_rng(given.seed), given.train)
        drives = []
        for n in range(given.drives):
            rng = np.random.default_rng(FIRST_SEED + n)
            hold = HOLDS_S[n % len(HOLDS_S)]
            drives.append(record(robot, rng, given.unseen, hold=hold))
        found = identify(recording, spec, alpha="auto")
        factor = 1e-9 if given.control == "standing" else 1.0
        model = replace(found.model, coefficients=factor * found.model.coefficients)
        found = replace(found, model=model)

        size = (round(10 * PHYSICS_S), len(spec.command))
        commands = np.random.default_rng(7).uniform(
            spec.command_low, spec.command_high, size
        )

        def simulate(robot: MujocoRobot = robot, commands: Array = commands) -> None:
            for command in commands:
                robot.step(command, 0.1)

        robot.reset(np.zeros(3))
        speed = measure_speeds(model, spec, {"mujoco": (simulate, PHYSICS_S)})
        if given.control == "slow":
            speed |= dict.fromkeys(("batched", "single"), speed["mujoco"])
        robots[name] = {
            **average_drives(found, drives, spec),
            "speed_up_batched": speed["batched"] / speed["mujoco"],
            "speed_up_single": speed["single"] / speed["mujoco"],
        }
    return {"robots": robots}


# The estimator

ESTIMATED = ("ackermann", "differential", "mecanum")
SECOND = 1_000_000_000
PERIOD = SECOND // 10
LATENCY = 100_000_000
LOST = 0.05
DRIVE_S = 30
# The estimate may be off by this part of what odometry is, over all robots and of each.
OF_ALL = 0.2
OF_EACH = 0.35
LEAST_PATH_M = 3.0  # a robot that drives less shows nothing
POSE_STD = np.array([0.02, 0.02, 0.02])  # of motion capture [m, m, rad]
STATE_DRIFT = 0.02  # part of its range by which the state drifts within a second
LEVELS = {
    "odom_linear": (0.05, "m/s"),
    "odom_angular": (0.05, "rad/s"),
    "position_drift": (0.03, "m/sqrt(s)"),
    "heading_drift": (0.03, "rad/sqrt(s)"),
}
WIDE = World.model_validate(
    {
        "name": "wide",
        "size": [200.0, 200.0],
        "clearance": 0.1,
        "goal_distance": [1.0, 3.0],
    }
)


@dataclass(frozen=True)
class Estimated:
    """Errors of one drive.

    Attributes:
        raw: (T,) squared distance of the odometry from the truth at its stamp [m^2].
        estimated: (T,) of the estimate from the truth at the time of asking [m^2].
        nees: of the pose at the newest measurement, at the end.
        path: that the robot truly drove [m].
    """

    raw: Array
    estimated: Array
    nees: float
    path: float


class _NoFilter(Middleware):
    """Takes odometry's own pose for that of the robot."""

    def view(self, now_ns: int) -> RobotView:
        seen = super().view(now_ns)
        newest = self.cache.newest.get(ODOM)
        return seen if newest is None else replace(seen, pose=newest.value[0])


def _expect_little(model: SimulatorModel) -> Middleware:
    """Returns a filter that expects a quarter of the noise."""
    few = make_levels({name: (std / 4.0, unit) for name, (std, unit) in LEVELS.items()})
    return Middleware(replace(model, noise=model.noise.model_copy(update=few)))


def make_levels(levels: Mapping[str, tuple[float, str]]) -> dict[str, Level]:
    """Returns measured levels of noise from their standard deviations and units."""
    return {
        name: Level(std=std, unit=unit, source="measured")
        for name, (std, unit) in levels.items()
    }


MAKES: dict[str | None, Callable[[SimulatorModel], Middleware]] = {
    "no_filter": _NoFilter,
    "overconfident": _expect_little,
}


def make_noisy(robot: str) -> SimulatorModel:
    """Returns a shipped robot with the noise of this benchmark."""
    model = builtin_model(robot)
    states = {
        v.name: (STATE_DRIFT * (v.max - v.min), f"{v.unit}/sqrt(s)")
        for v in model.robot.state
    }
    noise = Noise(**make_levels(LEVELS), state_drift=make_levels(states))
    return replace(model, noise=noise)


def estimate_drive(
    simulator: FastSimulator, middleware: Middleware, seed: int
) -> Estimated:
    """Drives at random; measurements are under way for the latency, and some get lost."""
    robot = simulator.model.robot
    rng = np.random.default_rng(seed)
    start = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    simulator.reset([seed], starts=start[None, None])
    middleware.reset(0, start)
    truth = [start]
    underway = deque[tuple[int, str, tuple[Any, ...]]]()
    raw = []
    estimated = []
    for k in range(DRIVE_S * 10):
        if k % 5 == 0:
            command = rng.uniform(robot.command_low, robot.command_high)
        middleware.command(k * PERIOD, command)
        simulator.step(command[None, None])
        now = (k + 1) * PERIOD
        data = simulator.data
        truth.append(data.pose[0, 0].copy())
        raw.append(np.sum((data.odom[0, 0] - truth[-1])[:2] ** 2))
        odometry = data.odom[0, 0].copy(), data.twist[0, 0].copy()
        captured = truth[-1] + rng.normal(size=3) * POSE_STD
        pose = captured, np.diag(POSE_STD**2)
        for topic, content in (("odom", odometry), ("pose", pose)):
            if rng.random() >= LOST:
                underway.append((now, topic, content))
        while underway and underway[0][0] + LATENCY <= now:
            stamp, topic, content = underway.popleft()
            take = middleware.odometry if topic == "odom" else middleware.pose
            take(stamp, now, *content)
        estimated.append(np.sum((middleware.view(now).pose - truth[-1])[:2] ** 2))
    belief = middleware.estimator.belief
    error = belief.mean[:3] - truth[belief.time_ns // PERIOD]
    error[2] = geometry.wrap_angle(error[2])
    nees = float(error @ np.linalg.solve(belief.covariance[:3, :3], error))
    path = np.hypot(*np.diff(np.array(truth)[:, :2], axis=0).T).sum()
    return Estimated(np.array(raw), np.array(estimated), nees, float(path))


def summarise_drives(drives: list[Estimated]) -> Result:
    """Returns what the drives show together."""
    from scipy.stats import chi2

    low, high = chi2.ppf([0.025, 0.975], 3 * len(drives)) / len(drives)
    raw = float(np.sqrt(np.mean([each.raw for each in drives])))
    estimated = float(np.sqrt(np.mean([each.estimated for each in drives])))
    return {
        "raw_rmse_m": raw,
        "ekf_rmse_m": estimated,
        "ekf_by_raw": estimated / raw,
        "nees_mean": float(np.mean([each.nees for each in drives])),
        "nees_95_band": [float(low), float(high)],
        "way_m": float(np.mean([each.path for each in drives])),
    }


def measure_estimator(given: Given) -> Result:
    """How far off are raw odometry and the estimate, and does the estimate know how far?

    Simulated drives of robots that drift, with noisy odometry and motion capture, both at 10 Hz,
    both 100 ms late, 5 % of them lost. The odometry is compared with where the robot was at its
    stamp; the estimate, harder, with where the robot is when it is asked, 100 ms later. NEES is
    that of the pose at the newest measurement, once at the end of each drive.
    """
    make = MAKES.get(given.control, Middleware)
    seeds = range(given.seed, given.seed + given.drives)
    found = {}
    for robot in ESTIMATED:
        model = make_noisy(robot)
        simulator = FastSimulator(model, WIDE)
        found[robot] = [estimate_drive(simulator, make(model), seed) for seed in seeds]
    return {
        **summarise_drives([each for drives in found.values() for each in drives]),
        "robots": {robot: summarise_drives(drives) for robot, drives in found.items()},
    }


def set_estimator_bars(result: Result) -> Bars:
    off = "the estimate is off, in parts of what odometry is, by"
    each = {"ekf_by_raw": at_most(OF_EACH, off), "way_m": at_least(LEAST_PATH_M)}
    return {
        "ekf_by_raw": at_most(OF_ALL, off),
        "nees_mean": Bar(*result["nees_95_band"], "NEES"),
        "robots": {"*": each},
    }


BENCHMARKS = {
    "real_drives": Benchmark(
        measure_real_drives,
        set_drive_bars,
        {
            "standing": Control("the model: it says the robot stands", "error_m"),
            "ordered": Control(
                "the shuffling of the commands that a yardstick loses by",
                "under shuffled commands",
                "--only ticks_02 --league",
            ),
        },
        {
            "league": (False, "with models that others fit"),
            "recordings": (RECORDINGS, "folder"),
            "only": some_of((*DRIVES, *ROBOTS)),
        },
        short=f"--only {SEGMENTED}",
        unsettled=("95 % band",),
    ),
    "generate_from_mujoco": Benchmark(
        measure_mujoco,
        {"robots": {"*": MUJOCO_BARS}},
        {
            "standing": Control("the model: it says the robot stands", "over_path"),
            "slow": Control("the model's speed: it is MuJoCo's", "MuJoCo's speed"),
        },
        {
            "train": (90.0, "to learn from [s]"),
            "unseen": (20.0, "of each other drive"),
            "drives": (8, "unseen ones"),
            "seed": (0, "of the drive to learn"),
            "robots": some_of(MUJOCO_ROBOTS),
        },
        short="--robots differential --train 40 --unseen 10 --drives 1",
        unsettled=("MuJoCo's speed",),
        needs=("mujoco",),
    ),
    "estimator": Benchmark(
        measure_estimator,
        set_estimator_bars,
        {
            "no_filter": Control("the filter: raw odometry stands in", "is off"),
            "overconfident": Control("three quarters of the noise expected", "NEES"),
        },
        {
            "drives": (100, "of each robot"),
            "seed": 0,
        },
        short="--drives 11",
    ),
}

if __name__ == "__main__":
    run_benchmark(BENCHMARKS)
