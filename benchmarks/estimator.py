"""How far off are raw odometry and the estimate, and does the estimate know how far off it is?

Simulated drives of robots that drift, with noisy odometry and motion capture, both at 10 Hz, both
100 ms late, 5 % of them lost. The odometry is compared with where the robot was at its stamp; the
estimate, harder, with where the robot is when it is asked, 100 ms later. NEES is that of the pose
at the newest measurement, once at the end of each drive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from bench import answer, parser_of
from numpy.typing import NDArray
from scipy.stats import chi2

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.middleware.measurement import ODOM
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


def run(drives: int, seed: int, control: str | None) -> dict[str, Any]:
    """Drives every robot."""
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
    return {
        **summary([each for robot in ROBOTS for each in found[robot]]),
        "robots": {robot: summary(found[robot]) for robot in ROBOTS},
        "drives": drives * len(ROBOTS),
    }


def missed(result: dict[str, Any]) -> list[str]:
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
    return said


def _missed_share(who: str, figures: dict[str, Any], most: float) -> list[str]:
    share = figures["ekf_rmse_m"] / figures["raw_rmse_m"]
    if share <= most:
        return []
    return [
        f"{who}: the estimate is off by {share:.2f} of what odometry is, more than {most}"
    ]


def main() -> None:
    """Prints a table, or one JSON object."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--drives", type=int, default=100, help="of each robot")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    result = run(given.drives, given.seed, given.control)
    answer(result, missed(result), given.json)


if __name__ == "__main__":
    main()
