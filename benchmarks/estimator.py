"""How far off are raw odometry and the estimate, and does the estimate know how far off it is?

Simulated drives of robots that drift, with noisy odometry and motion capture, both at 10 Hz, both
100 ms late, 5 % of them lost. The odometry is compared with where the robot was at its stamp; the
estimate, harder, with where the robot is when it is asked, 100 ms later. NEES is that of the pose
at the newest measurement, once at the end of each drive. Then random steps, all of which
have to leave the covariance finite, symmetric and positive definite.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from measuring.verdict import answer, parser_of
from numpy.typing import NDArray
from scipy.stats import chi2

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.ekf import Estimator
from nics_drl_bridge.middleware.measurement import ODOM, Kind
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

Array = NDArray[np.float64]
ROBOTS = ("ackermann", "differential", "mecanum")
SECOND = 1_000_000_000
PERIOD = SECOND // 10
LATENCY = 100_000_000
LOST = 0.05
DRIVE_S = 30
CONTROLS = {
    "no_filter": "raw odometry in place of the estimate",
    "overconfident": "a filter that expects a quarter of the noise",
    "nan": "an estimate that is no number",
    "stands": "robots that do not move",
}
SHARE, SHARE_OF_EACH = 0.2, 0.35
"""The estimate may be off by this share of what odometry is, over all robots and of each."""
LEAST_WAY_M = 3.0
"""A robot that drives less [m] shows nothing."""
POSE_STD = np.array([0.02, 0.02, 0.02])
"""Of motion capture [m, m, rad]."""
STATE_DRIFT = 0.02
"""The state drifts by this share of its range within a second."""
NOISE = Noise(
    odom_linear=Level(std=0.05, unit="m/s", source="measured"),
    odom_angular=Level(std=0.05, unit="rad/s", source="measured"),
    position_drift=Level(std=0.03, unit="m/sqrt(s)", source="measured"),
    heading_drift=Level(std=0.03, unit="rad/sqrt(s)", source="measured"),
)
WIDE = World.model_validate(
    {
        "name": "wide",
        "size": [200.0, 200.0],
        "clearance": 0.1,
        "goal_distance": [1.0, 3.0],
    }
)


@dataclass(frozen=True)
class Drive:
    """Errors of one drive.

    Attributes:
        raw: (T,) squared distance of the odometry from the truth at its stamp [m^2].
        estimated: (T,) of the estimate from the truth at the time of asking [m^2].
        nees: of the pose at the newest measurement, at the end.
        way: that the robot truly drove [m].
    """

    raw: Array
    estimated: Array
    nees: float
    way: float


class _NoFilter(Middleware):
    """Takes odometry's own pose for that of the robot."""

    def view(self, now_ns: int) -> RobotView:
        seen = super().view(now_ns)
        newest = self.cache.newest.get(ODOM)
        return seen if newest is None else replace(seen, pose=newest.value[0])


class _NoNumber(Middleware):
    def view(self, now_ns: int) -> RobotView:
        return replace(super().view(now_ns), pose=np.full(3, np.nan))


def _overconfident(model: SimulatorModel) -> Middleware:
    levels = {
        name: level.model_copy(update={"std": level.std / 4.0})
        for name in type(NOISE).model_fields
        if isinstance(level := getattr(model.noise, name), Level)
    }
    return Middleware(replace(model, noise=model.noise.model_copy(update=levels)))


MAKES: dict[str | None, Callable[[SimulatorModel], Middleware]] = {
    "no_filter": _NoFilter,
    "overconfident": _overconfident,
    "nan": _NoNumber,
}


def noisy(robot: str) -> SimulatorModel:
    """A shipped robot with the noise of this benchmark."""
    model = builtin_model(robot)
    states = {
        v.name: Level(
            std=STATE_DRIFT * (v.max - v.min),
            unit=f"{v.unit}/sqrt(s)",
            source="measured",
        )
        for v in model.robot.state
    }
    return replace(model, noise=NOISE.model_copy(update={"state_drift": states}))


def drive(
    model: SimulatorModel,
    simulator: FastSimulator,
    middleware: Middleware,
    seed: int,
    moving: bool,
) -> Drive:
    """Drives at random; measurements are under way for the latency, and some get lost."""
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
            command = (
                rng.uniform(model.robot.command_low, model.robot.command_high) * moving
            )
        middleware.command(k * PERIOD, command)
        simulator.step(command[None, None])
        now = (k + 1) * PERIOD
        data = simulator.data
        truth.append(data.pose[0, 0].copy())
        raw.append(np.sum((data.odom[0, 0] - truth[-1])[:2] ** 2))
        odometry = data.odom[0, 0].copy(), data.twist[0, 0].copy()
        captured = truth[-1] + rng.normal(size=3) * POSE_STD
        for topic, content in (
            ("odom", odometry),
            ("pose", (captured, np.diag(POSE_STD**2))),
        ):
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
    way = np.hypot(*np.diff(np.array(truth)[:, :2], axis=0).T).sum()
    return Drive(np.array(raw), np.array(estimated), nees, float(way))


def summary(drives: list[Drive]) -> dict[str, Any]:
    """What the drives show together."""
    low, high = chi2.ppf([0.025, 0.975], 3 * len(drives)) / len(drives)
    return {
        "raw_rmse_m": float(np.sqrt(np.mean([each.raw for each in drives]))),
        "ekf_rmse_m": float(np.sqrt(np.mean([each.estimated for each in drives]))),
        "nees_mean": float(np.mean([each.nees for each in drives])),
        "nees_95_band": [float(low), float(high)],
        "way_m": float(np.mean([each.way for each in drives])),
    }


def random_steps(model: SimulatorModel, steps: int, seed: int) -> dict[str, Any]:
    """Predicts and updates at random, and looks at the covariance after every step."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(model)
    now = 0
    low = model.robot.command_low
    high = model.robot.command_high
    sound = True
    for step in range(steps):
        kind = int(rng.integers(5))
        if kind == 0:
            now += int(rng.integers(1, 3 * PERIOD))
            estimator.predict(now)
        elif kind == 1:
            estimator.add_command(now, rng.uniform(low, high))
        elif kind == 2:
            estimator.update(
                Kind.TWIST, rng.normal(size=3) * 10.0 ** rng.uniform(-3.0, 2.0)
            )
        elif kind == 3:
            estimator.update(
                Kind.YAW_RATE, float(rng.normal()), 10.0 ** rng.uniform(-6.0, 1.0)
            )
        else:
            estimator.update(
                Kind.POSE, rng.normal(size=3), 10.0 ** rng.uniform(-6.0, 3.0, 3)
            )
        mean = estimator.belief.mean
        covariance = estimator.belief.covariance
        sound = sound and bool(
            np.isfinite(mean).all() and (covariance == covariance.T).all()
        )
        try:
            np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            sound = False
        if not sound:
            return {"random_steps": step + 1, "finite_and_positive_definite": False}
    return {"random_steps": steps, "finite_and_positive_definite": True}


def cycle_us(model: SimulatorModel, cycles: int) -> float:
    """Median time of what the single env asks of the middleware in a step [us]."""
    middleware = Middleware(model)
    times = []
    middleware.reset(0, np.zeros(3))
    ranges = np.ones(model.lidar.beams, np.float32)
    command = 0.3 * model.robot.command_high
    for k in range(cycles):
        now = (k + 1) * PERIOD
        twist = middleware.view(now).twist
        begin = time.perf_counter()
        middleware.command(k * PERIOD, command)
        middleware.odometry(now, now, np.zeros(3), twist)
        middleware.scan(now, now, ranges)
        middleware.view(now)
        times.append(time.perf_counter() - begin)
    return float(np.median(times)) * 1e6


def run(drives: int, steps: int, seed: int, control: str | None) -> dict[str, Any]:
    """Drives every robot, then takes random steps with one after the other."""
    found = {}
    moving = control != "stands"
    make = MAKES.get(control, Middleware)
    for robot in ROBOTS:
        model = noisy(robot)
        simulator = FastSimulator(model, WIDE)
        seeds = range(seed, seed + drives)
        found[robot] = [
            drive(model, simulator, make(model), one, moving) for one in seeds
        ]
    shares = [random_steps(noisy(r), -(-steps // len(ROBOTS)), seed) for r in ROBOTS]
    return {
        **summary([each for robot in ROBOTS for each in found[robot]]),
        "robots": {robot: summary(found[robot]) for robot in ROBOTS},
        "drives": drives * len(ROBOTS),
        "random_steps": sum(share["random_steps"] for share in shares),
        "finite_and_positive_definite": all(
            share["finite_and_positive_definite"] for share in shares
        ),
        "cycle_us": cycle_us(noisy(ROBOTS[0]), 3000),
    }


def missed(result: dict[str, Any], steps: int) -> list[str]:
    """A sentence for each bar that was missed."""
    said = _missed_share("all robots", result, SHARE)
    for robot, each in result["robots"].items():
        said += _missed_share(robot, each, SHARE_OF_EACH)
        if not each["way_m"] >= LEAST_WAY_M:
            said.append(
                f"{robot} drove {each['way_m']:.2f} m a drive, less than {LEAST_WAY_M} m"
            )
    low, high = result["nees_95_band"]
    if not low <= result["nees_mean"] <= high:
        said.append(
            f"NEES is {result['nees_mean']:.2f}, not within {low:.2f} to {high:.2f}"
        )
    if not (
        result["finite_and_positive_definite"] and result["random_steps"] >= steps > 0
    ):
        said.append(
            f"the covariance was unsound after {result['random_steps']} random steps"
        )
    return said


def _missed_share(who: str, figures: dict[str, Any], most: float) -> list[str]:
    share = figures["ekf_rmse_m"] / figures["raw_rmse_m"]
    if share <= most:
        return []
    return [
        f"{who}: the estimate is off by {share:.2f} of what odometry is, more than {most}"
    ]


def table_of(result: dict[str, Any]) -> str:
    """The figures for people."""
    row = "{:<14}{:>10}{:>10}{:>8}   {}\n"
    text = row.format("", "raw [m]", "EKF [m]", "NEES", "95 % band")
    for name, each in {**result["robots"], "all": result}.items():
        low, high = each["nees_95_band"]
        text += row.format(
            name,
            f"{each['raw_rmse_m']:.3f}",
            f"{each['ekf_rmse_m']:.3f}",
            f"{each['nees_mean']:.2f}",
            f"{low:.2f} to {high:.2f}",
        )
    sound = "all" if result["finite_and_positive_definite"] else "NOT all"
    return (
        f"{text}{result['random_steps']} random steps, {sound} finite and positive definite; "
        f"{result['cycle_us']:.0f} us for command, odometry, scan and view\n"
    )


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--drives", type=int, default=100, help="of each robot")
    parser.add_argument("--steps", type=int, default=1_000_000, help="random steps")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    result = run(given.drives, given.steps, given.seed, given.control)
    answer(result, missed(result, given.steps), table_of(result), given.json)


if __name__ == "__main__":
    main()
