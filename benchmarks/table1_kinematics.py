"""The paper's Table I: how exact, how small and how fast are the fitted, pruned models?

Textbook kinematics without actuator lag. A robot of wheel speeds (and steering) that change at
random every step moves along exact arcs; the model is fitted to the first drive and tried on
another. Errors are root mean squares per step of 1 ms, in the body frame, in float64.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from bench import answer, parser_of
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.identify.fit import fit
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import kernels
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import CommandVariable, RobotSpec, load_robot
from nics_drl_bridge.robot.taylor import TaylorModel

CONTROLS = {
    "rounded": "the coefficients of the fitted models have two digits",
    "nan": "one coefficient is none",
    "slow": "the textbook in plain Python in place of the compiled model",
}
Array = NDArray[np.float64]
DT = 1e-3
STEPS = 40_000
SPEED = 1.0
STEERING = 0.5
PARAMETERS = {
    "ackermann": {"wheelbase": 0.2},
    "differential": {"wheel_radius": 0.05, "track": 0.2},
    "mecanum": {"wheel_radius": 0.05, "half_length": 0.1, "half_width": 0.1},
}
PAPER = {
    "ackermann": (3.08e-9, 9.71e-6, 9.89e-5, 9.01e4),
    "differential": (2.56e-7, 5.11e-9, 1.56e-16, 5.72e4),
    "mecanum": (1.23e-17, 9.41e-18, 3.75e-17, 4.73e4),
}
EXACT = 1e-12
"""Below this an error is rounding, whatever the paper has."""
FASTER_ALONE, FASTER_TOGETHER = 100.0, 1000.0
"""Times the speed of plain Python in the same run."""
FLOAT32_M = 1e-4
ROBOTS = 1024
BATCHED_STEPS = 400
SINGLE_STEPS = 100_000
REPEATS = 7


@dataclass(frozen=True)
class Subject:
    """A robot without lag: X is its wheel speeds (and steering), and gives the body twist."""

    spec: RobotSpec
    twist: Callable[[Array], Array]


def subject(name: str) -> Subject:
    """The textbook robot of that name with the parameters of the benchmark."""
    shipped = load_robot(name)
    parameters = {**shipped.parameters, **PARAMETERS[name]}
    full = shipped.model_copy(update={"parameters": parameters})
    radius = PARAMETERS[name].get("wheel_radius", 1.0)
    inputs = tuple(
        CommandVariable(
            name=v.name,
            unit=v.unit,
            min=-(STEERING if v.unit == "rad" else SPEED / radius),
            max=STEERING if v.unit == "rad" else SPEED / radius,
        )
        for v in shipped.state
    )
    spec = full.model_copy(update={"state": (), "command": inputs})
    return Subject(RobotSpec.model_validate(spec.model_dump()), textbook(full).twist)


def drive(robot: Subject, seed: int) -> Samples:
    """A drive whose inputs change at random every step; the pose moves along exact arcs."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(
        robot.spec.command_low,
        robot.spec.command_high,
        (STEPS, len(robot.spec.command)),
    )
    moved = geometry.exp(robot.twist(x) * DT)
    t = np.arange(STEPS) * DT
    return Samples(t=t, q=np.zeros((STEPS, 3)), x=x, dq=geometry.log(moved) / DT, dt=DT)


def errors(model: TaylorModel, robot: Subject, seed: int) -> tuple[Array, Array]:
    """RMSE (3,) per step in the body frame, and of the body twist times the step."""
    x = drive(robot, seed).x
    truth = robot.twist(x) * DT
    guess = model.rates(x) * DT
    a = geometry.exp(truth)
    b = geometry.exp(guess)
    difference = np.concatenate(
        [b[:, :2] - a[:, :2], guess[:, 2:] - truth[:, 2:]], axis=1
    )
    return rms(difference), rms(guess - truth)


def rms(values: Array) -> Array:
    """Root mean square over the first axis."""
    return np.sqrt((values**2).mean(axis=0))


def batch(
    model: TaylorModel, dtype: type, robots: int, robot: Subject
) -> tuple[Any, ...]:
    """Arguments of `kernels.run` for robots at the origin under random inputs."""
    terms = kernels.make_terms(model)
    rng = np.random.default_rng(3)
    x = np.ones((len(model.variables) + 1, robots), dtype)
    low = robot.spec.command_low
    high = robot.spec.command_high
    x[:-1] = rng.uniform(low[:, None], high[:, None], (len(low), robots))
    pose = np.zeros((6, robots), dtype)
    pose[2] = 1.0
    each = np.repeat(terms.coefficient[:, None], robots, axis=1).astype(dtype)
    terms = terms._replace(coefficient=each)
    dq = np.zeros((len(model.dofs), robots), dtype)
    return pose, x, dq, terms, kernels.SERIES.astype(dtype), dtype(model.dt)


def float32_error(model: TaylorModel, robot: Subject) -> float:
    """Largest distance between float32 and float64 after 1,000 steps [m]."""
    ends = []
    for dtype in (np.float32, np.float64):
        arguments = batch(model, dtype, ROBOTS, robot)
        kernels.run(*arguments, 1000)
        ends.append(arguments[0][:2].astype(np.float64))
    return float(np.hypot(*(ends[0] - ends[1])).max())


def batched_rate(model: TaylorModel, dtype: type, robot: Subject) -> float:
    """Robot-steps per second of many robots on one thread; the best of several runs."""
    arguments = batch(model, dtype, ROBOTS, robot)
    return ROBOTS * BATCHED_STEPS / best(lambda: kernels.run(*arguments, BATCHED_STEPS))


def single_rate(model: TaylorModel, robot: Subject) -> float:
    """Steps per second of one robot, with a command per step, many steps in one call."""
    rng = np.random.default_rng(4)
    low = robot.spec.command_low
    high = robot.spec.command_high
    commands = rng.uniform(low, high, (1, SINGLE_STEPS, len(low)))
    poses, states = (
        np.zeros((1, SINGLE_STEPS + 1, 3)),
        np.zeros((1, SINGLE_STEPS + 1, 0)),
    )
    terms = kernels.make_terms(model)
    return SINGLE_STEPS / best(
        lambda: kernels.simulate_rollouts(
            poses, states, commands, terms, kernels.SERIES, DT
        )
    )


def best(call: Callable[[], None]) -> float:
    """Shortest time of a call, which is made once before [s]."""
    call()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def python_rate(robot: Subject) -> float:
    """Steps per second of the textbook kinematics in plain Python and numpy."""
    x = drive(robot, 5).x
    pose = np.zeros(3)
    steps = 2000
    begin = time.perf_counter()
    for row in x[:steps]:
        pose = geometry.compose(pose, geometry.exp(robot.twist(row) * DT))
    return steps / (time.perf_counter() - begin)


def without(model: TaylorModel, control: str | None) -> TaylorModel:
    """The model with what a control takes out."""
    coefficients = model.coefficients.copy()
    if control == "rounded":
        digits = [float(f"{value:.2g}") for value in coefficients.ravel()]
        coefficients = np.array(digits).reshape(coefficients.shape)
    elif control == "nan":
        coefficients[np.nonzero(coefficients)[0][0], np.nonzero(coefficients)[1][0]] = (
            np.nan
        )
    return replace(model, coefficients=coefficients)


def measure(name: str, control: str | None) -> dict[str, Any]:
    """All figures of one robot."""
    robot = subject(name)
    found = fit(drive(robot, 1), robot.spec)
    model = without(found.model, control)
    step, twist = errors(model, robot, 2)
    if control == "slow":
        single = batched = python_rate(robot)
    else:
        single = single_rate(model, robot)
        batched = batched_rate(model, np.float64, robot)
    return {
        "rmse_x_m": float(step[0]),
        "rmse_y_m": float(step[1]),
        "rmse_heading_rad": float(step[2]),
        "rmse_twist": [float(value) for value in twist],
        "terms_kept": model.terms_kept,
        "terms_total": found.regression.terms_total,
        "steps_per_s_single": single,
        "steps_per_s_batched": batched,
        "steps_per_s_batched_float32": batched_rate(model, np.float32, robot),
        "float32_error_after_1000_steps_m": float32_error(model, robot),
    }


def missed_of(result: dict[str, Any]) -> list[str]:
    """The bars that were missed."""
    missed = []
    python = result["python_reference_steps_per_s"]
    for name, robot in result["robots"].items():
        keys = ("rmse_x_m", "rmse_y_m", "rmse_heading_rad")
        for key, paper in zip(keys, PAPER[name], strict=False):
            bar = max(paper, EXACT)
            if not robot[key] <= bar:
                missed.append(f"{name}: {key} {robot[key]:.2e}, bar {bar:.2e}")
        error = robot["float32_error_after_1000_steps_m"]
        if not error <= FLOAT32_M:
            missed.append(f"{name}: float32 is off by {error:.2e} m, bar {FLOAT32_M:g}")
        for key, bar in (
            ("steps_per_s_single", FASTER_ALONE),
            ("steps_per_s_batched", FASTER_TOGETHER),
        ):
            if not robot[key] >= bar * python:
                times = robot[key] / python
                missed.append(
                    f"{name}: {key} is {times:.3g} times plain Python's, bar {bar:g}"
                )
    return missed


def order4_heading() -> float:
    """RMSE of the heading per step of an Ackermann model with the terms up to order 4 [rad]."""
    robot = subject("ackermann")
    return float(
        errors(fit(drive(robot, 1), robot.spec, order=4).model, robot, 2)[0][2]
    )


def table(result: dict[str, Any]) -> str:
    """The figures beside the paper's."""
    head = (
        "robot",
        "",
        "x [m]",
        "y [m]",
        "heading [rad]",
        "terms",
        "single /s",
        "batched /s",
    )
    row = "{:<14}{:<7}{:>10}{:>10}{:>15}{:>9}{:>12}{:>12}\n"
    text = row.format(*head)
    for name, r in result["robots"].items():
        mine = [f"{r[key]:.2e}" for key in ("rmse_x_m", "rmse_y_m", "rmse_heading_rad")]
        rates = [
            f"{r[key]:.2e}" for key in ("steps_per_s_single", "steps_per_s_batched")
        ]
        text += row.format(
            name, "ours", *mine, f"{r['terms_kept']}/{r['terms_total']}", *rates
        )
        text += row.format(
            "",
            "paper",
            *(f"{v:.2e}" for v in PAPER[name][:3]),
            "",
            f"{PAPER[name][3]:.2e}",
            "",
        )
    heading_rmse = result["ackermann_order4_rmse_heading_rad"]
    text += f"Ackermann heading with order 4: {heading_rmse:.2e} rad\n"
    text += f"plain Python: {result['python_reference_steps_per_s']:.2e} steps/s\n"
    return text


def main() -> None:
    """Prints a table, or one JSON object."""
    given = parser_of(__doc__, CONTROLS).parse_args()
    result = {
        "robots": {name: measure(name, given.control) for name in PARAMETERS},
        "ackermann_order4_rmse_heading_rad": order4_heading(),
        "python_reference_steps_per_s": python_rate(subject("ackermann")),
    }
    answer(result, missed_of(result), given.json, table(result))


if __name__ == "__main__":
    main()
