"""Models of a drive that others fit: what each is given, and where it says the robot ends.

Each learns from the part that ours learns from, on the clock that ours found, and predicts the same
windows from the poses and twists at their starts. Those that search start at the fitted textbook.
"""

import io
import itertools
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import Any

import numpy as np
import scipy.signal
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.alignment import average_held, choose_half_width
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.identify.drive import Drive, unwrap_headings
from nics_drl_bridge.identify.open_loop import HORIZON_S, Windows, select_windows
from nics_drl_bridge.identify.shooting import HEADING_ARM_M
from nics_drl_bridge.identify.textbook import (
    HORIZONS_S,
    LOSS_SCALE,
    TextbookResponse,
    Yardstick,
    estimate_twists_at,
    probe_structure,
)
from nics_drl_bridge.robot.taylor import evaluate

STEP_S = 0.02
FREE = 1e3  # limit of accelerations that is never reached [m/s^2]


@dataclass(frozen=True)
class Lesson:
    """What a method is given of a drive."""

    drive: Drive
    until_s: float  # end of the part to learn from
    textbook: Yardstick  # fitted to that part

    @cached_property
    def grid_t(self) -> Array:
        """Times (G,) on the pose's clock, from before the drive to its end [s]."""
        t = self.drive.dated.t
        return np.arange(t[0] - 1.0, t[-1] + 1.0, STEP_S)

    @cached_property
    def command(self) -> Array:
        """Means (G, C) of the commands over steps of the grid."""
        t = self.grid_t + self.textbook.clock_offset_s
        return average_held(
            self.drive.recording.command, self.drive.spec, t, t + STEP_S
        )

    def commands_at(self, t: Array) -> Array:
        """Returns the commands (N, C) from times (N,) on, over a step."""
        columns = [np.interp(t, self.grid_t, column) for column in self.command.T]
        return np.stack(columns, axis=-1)


Predictor = Callable[[Windows], Array]


def use_nominal(lesson: Lesson) -> Predictor:
    """Returns the textbook with the numbers of the robot's description."""
    spec = lesson.drive.spec
    structure = probe_structure(spec)
    assert structure is not None
    lags = [value for name, value in spec.parameters.items() if name.endswith("_lag")]
    response = replace(
        lesson.textbook.response,
        delay_s=0.0,
        gain=structure[0],
        offset=np.zeros(3),
        lag_s=np.array([lags[0], lags[0], lags[-1]]),
        limit=np.full(2, FREE),
        bicycle=structure[1],
    )
    nominal = replace(lesson.textbook, response=response)
    return lambda chosen: nominal.predict(lesson.drive, chosen)


# mujoco.sysid: one rear and one steered front wheel, or a body with two motors

PLANAR = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <joint axis="0 0 1"/>
      <inertial pos="{centre} 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/>
      <site name="rear"/>
      <body pos="{wheelbase} 0 0">
        <joint name="steering" axis="0 0 1"/>
        <inertial pos="0 0 0" mass="1e-3" diaginertia="1e-5 1e-5 1e-5"/>
        <site name="front"/>
      </body>
    </body>
  </worldbody>
  <default>
    <general biastype="affine"/>
  </default>
  <actuator>
    <general site="rear" gear="1 0 0 0 0 0" gainprm="{drive}" biasprm="0 0 -{drive}"
             forcerange="-{brake} {limit}"/>
    <general joint="steering" gainprm="1" biasprm="0 -1 -{lag}"/>
    <general site="rear" gear="0 0 0 0 0 1" gainprm="{turn}" biasprm="0 0 -{turn}"/>
    <general site="rear" gear="0 1 0 0 0 0" biasprm="0 0 -{rear}"
             forcerange="-{rear_grip} {rear_grip}"/>
    <general site="front" gear="0 1 0 0 0 0" biasprm="0 0 -{front}"
             forcerange="-{front_grip} {front_grip}"/>
  </actuator>
</mujoco>
"""
WINDOWS = 50
# multiples of the first values of tyres from which the best is refined
FIRST = {
    "front": (1.0, 0.3, 0.1),
    "front_grip": (1.0, 0.3, 0.1),
    "rear_grip": (1.0, 0.3),
}
HEADINGS = np.array([1.0, 1.0, HEADING_ARM_M])


@dataclass(frozen=True)
class Planar:
    """A body on a plane in MuJoCo, which actuators drive as the textbook's structure says."""

    lesson: Lesson
    fixed: dict[str, float]  # constants of the model
    scaled: dict[str, float]  # first values of those that are fitted, as multiples

    @property
    def response(self) -> TextbookResponse:
        return self.lesson.textbook.response

    def declare(self) -> Any:
        """Returns the parameters, which start at the fitted textbook."""
        from mujoco.sysid import Parameter, ParameterDict

        r = self.response
        gain = r.gain[r.gain != 0.0]
        many = np.full(len(self.scaled), 5.0)
        sideways = 0.3 if r.bicycle.used else 1e-6
        place = np.array([0.3, sideways, np.pi / 2.0])
        parameters = (
            Parameter("delay", r.delay_s, r.delay_s - 0.2, r.delay_s + 0.2),
            Parameter("gain", gain, gain - np.abs(gain), gain + np.abs(gain)),
            Parameter("offset", r.offset[[0, 2]], [-2.0, -1.0], [2.0, 1.0]),
            Parameter("scale", 0.0 * many, -many, many),
            Parameter("mounting", r.mounting, r.mounting - place, r.mounting + place),
        )
        return ParameterDict({each.name: each for each in parameters})

    def roll(self, candidate: Any, start_t: Array, duration: Array) -> Array:
        """Returns poses (W, H, 3) of the tracked body, relative to its pose at the starts."""
        import mujoco
        from mujoco import rollout

        scale = np.exp(candidate["scale"].value)
        scaled = scale * list(self.scaled.values())
        values = self.fixed | dict(zip(self.scaled, scaled, strict=True))
        values["lag"] = max(values["lag"], STEP_S)
        text = PLANAR.format(step=STEP_S, **values)
        model = mujoco.MjModel.from_xml_string(text)
        count = len(start_t)
        steps = int(np.ceil(duration.max() / STEP_S)) + 1
        grid = self.lesson.grid_t
        speed, turn = self.aim(candidate).T
        begin = start_t - candidate["delay"].value
        at = begin[:, None] + STEP_S * np.arange(steps)
        control = np.zeros((count, steps, 5))
        control[..., 0] = np.interp(at, grid, speed)
        control[..., 1] = control[..., 2] = np.interp(at, grid, turn)
        share = 1.0 - np.exp(-STEP_S / values["lag"])
        angle = scipy.signal.lfilter([0.0, share], [1.0, share - 1.0], turn)
        place = candidate["mounting"].value
        twist = estimate_twists_at(self.lesson.drive, start_t)
        arm = np.array([place[1], -place[0]]) * twist[:, 2:]
        state = np.zeros((count, 9))
        state[:, 4] = np.interp(begin, grid, angle)
        state[:, 5:7] = geometry.rotate(twist[:, :2], place[2]) + arm
        state[:, 7] = twist[:, 2]
        threads = [mujoco.MjData(model) for _ in range(2)]
        rolled, _ = rollout.rollout(model, threads, state, control)
        poses = np.concatenate([state[:, None], rolled], axis=1)[..., 1:4]
        before = (duration / STEP_S).astype(np.intp)
        part = (duration / STEP_S - before)[..., None]
        row = np.arange(count)[:, None]
        ends = (1.0 - part) * poses[row, before] + part * poses[row, before + 1]
        back = geometry.between(place, np.zeros(3))
        return geometry.compose(back, geometry.compose(ends, place))

    def aim(self, candidate: Any) -> Array:
        """Returns the speeds, and the angles or turn rates, (G, 2) that commands ask for."""
        gain = self.response.gain.copy()
        gain[gain != 0.0] = candidate["gain"].value
        target = (self.lesson.command @ gain.T)[:, [0, 2]]
        offset = candidate["offset"].value
        if self.response.bicycle.used:  # a command of zero means stop
            more = np.maximum(np.abs(target[:, 0]) + offset[0], 0.0)
            offset = np.array([0.0, offset[1]])
            target[:, 0] = np.sign(target[:, 0]) * more
        return target + offset


def build_planar(lesson: Lesson) -> Planar:
    """Returns a body with two motors, or with a driven rear and a steered front wheel."""
    response = lesson.textbook.response
    length = response.bicycle.wheelbase if response.bicycle.used else 0.3
    inertia = length**2
    fixed = {
        "lag": 0.1,
        "wheelbase": length,
        "front": 0.0,
        "turn": 0.0,
        "front_grip": FREE,
        "rear_grip": FREE,
    }
    scaled = {
        "drive": 1.0 / response.lag_s[0],
        "limit": response.limit[0],
        "brake": response.limit[1],
        "centre": 0.01 * length,
        "inertia": inertia,
        "rear": 50.0,
    }
    if response.bicycle.used:
        scaled |= {
            "lag": max(response.lag_s[2], STEP_S),
            "wheelbase": length,
            "centre": 0.5 * length,
            "inertia": 0.2 * inertia,
            "front": 50.0,
            "front_grip": 10.0,
            "rear_grip": 10.0,
        }
    else:
        scaled["turn"] = inertia / response.lag_s[2]
    return Planar(lesson, fixed, scaled)


def fit_sysid(lesson: Lesson) -> Predictor:
    """Fits a planar body by MuJoCo's own Gauss-Newton over batched roll-outs."""
    from mujoco import sysid

    planar = build_planar(lesson)
    spacing = max(0.1, (lesson.until_s - HORIZON_S) / WINDOWS)
    chosen = select_windows(
        lesson.drive, Calibration(), 0.0, lesson.until_s, HORIZON_S, spacing
    )
    durations = np.tile(HORIZONS_S, (len(chosen.start_t), 1))
    at = chosen.start_t[:, None] + durations
    pose = unwrap_headings(lesson.drive.dated.values)
    ends = [np.interp(at, lesson.drive.dated.t, column) for column in pose.T]
    measured = geometry.between(chosen.start[:, None], np.stack(ends, axis=-1))

    def compare(x: Array, parameters: Any) -> tuple[list[Array], None, None]:
        errors = []
        for column in x.reshape(len(x), -1).T:
            parameters.update_from_vector(column)
            error = planar.roll(parameters, chosen.start_t, durations) - measured
            error[..., 2] = geometry.wrap_angle(error[..., 2])
            error = np.clip(error * HEADINGS / durations[..., None], -100.0, 100.0)
            scaled = (np.nan_to_num(error) / LOSS_SCALE) ** 2
            # Its squares sum up to the soft L1 loss that the textbook is fitted by.
            robust = np.sign(error) * np.sqrt(np.sqrt(1.0 + scaled) - 1.0)
            errors.append(robust.ravel())
        return [np.stack(errors, axis=-1) if x.ndim > 1 else errors[0]], None, None

    parameters = planar.declare()
    names = list(planar.scaled)
    starts = []
    for factors in itertools.product(*(FIRST.get(name, (1.0,)) for name in names)):
        parameters["scale"].value = np.log(factors)
        starts.append(parameters.as_vector())
    costs = (compare(np.array(starts).T, parameters.copy())[0][0] ** 2).sum(axis=0)
    soft = costs.min() < 0.8 * costs[0]  # the tyres evidently slip
    parameters.update_from_vector(starts[int(np.argmin(costs)) if soft else 0])
    best, _ = sysid.optimize(
        parameters,
        compare,
        verbose=False,
        max_iters=20,
        x_scale="jac",
        eps=1e-4,
        output=io.StringIO(),
    )

    def predict(windows: Windows) -> Array:
        duration = (windows.end_t - windows.start_t)[:, None]
        relative = planar.roll(best, windows.start_t, duration)
        return geometry.compose(windows.start, relative[:, 0])

    return predict


# PySINDy: sparse polynomials in twist and commands

DEGREES = (1, 2)
THRESHOLDS = (0.01, 0.3)  # in standard deviations per second
SMOOTHED = (5, 31)  # steps that a parabola is fitted to
RIDGES = (1.0, 30.0)
FASTEST = 20.0  # standard deviations beyond which a roll-out has blown up


@dataclass(frozen=True)
class Sparse:
    """Rates of the twist by SINDy, all in standard deviations."""

    lesson: Lesson
    powers: NDArray[np.int64]  # (K, 3 + C) exponents of twist and commands
    coefficients: Array  # (3, K)
    twist_scale: Array
    command_scale: Array

    def rates(self, twist: Array, command: Array) -> Array:
        features = evaluate(np.concatenate([twist, command], axis=1), self.powers)
        return features @ self.coefficients.T

    def predict(self, chosen: Windows) -> Array:
        """Integrates twists from those at the starts to poses (W, 3) at the ends of windows."""
        x = estimate_twists_at(self.lesson.drive, chosen.start_t) / self.twist_scale
        delay = self.lesson.textbook.response.delay_s
        duration = chosen.end_t - chosen.start_t
        pose = chosen.start
        for k in range(int(np.ceil(duration.max() / STEP_S - 1e-6))):
            u = self.lesson.commands_at(chosen.start_t + k * STEP_S - delay)
            u = u / self.command_scale
            dt = np.clip(duration - k * STEP_S, 0.0, STEP_S)[:, None]
            middle = x + 0.5 * dt * self.rates(x, u)
            middle = np.clip(middle, -FASTEST, FASTEST)
            x = np.clip(x + dt * self.rates(middle, u), -FASTEST, FASTEST)
            moved = geometry.exp(dt * middle * self.twist_scale)
            pose = geometry.compose(pose, moved)
        return pose


def learn_sparse(
    lesson: Lesson, stop: float, degree: int, threshold: float, width: int, ridge: float
) -> Sparse:
    """Fits SINDy with the commands as control inputs up to a time [s]."""
    import pysindy

    drive = lesson.drive
    t = np.arange(drive.dated.t[0], drive.recording.pose.t[0] + stop, STEP_S)
    twist = estimate_twists_at(drive, t)
    # Commands are smoothed as the twists are: over the poses of a parabola, and by SINDy's filter.
    half = round(0.77 * choose_half_width(drive) / STEP_S)
    command = uniform_filter1d(
        lesson.commands_at(t - lesson.textbook.response.delay_s), 2 * half + 1, axis=0
    )
    smoother = {"window_length": width, "polyorder": 2}
    command = scipy.signal.savgol_filter(command, axis=0, **smoother)
    scales = [
        np.where(np.std(values, axis=0) > 1e-6, np.std(values, axis=0), 1.0)
        for values in (twist, command)
    ]
    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=threshold, alpha=ridge),
        feature_library=pysindy.PolynomialLibrary(degree=degree),
        differentiation_method=pysindy.SmoothedFiniteDifference(smoother_kws=smoother),
    )
    with warnings.catch_warnings():  # of columns without a term
        warnings.simplefilter("ignore")
        model.fit(twist / scales[0], t=STEP_S, u=command / scales[1])
    powers = model.feature_library.powers_
    return Sparse(lesson, powers, model.coefficients(), *scales)


def fit_sindy(lesson: Lesson) -> Predictor:
    """Fits the polynomial that predicts best: unseen parts, and what it learned from in the end."""
    inner = 2.0 / 3.0 * lesson.until_s
    parts = [
        (stop, select_windows(lesson.drive, Calibration(), start, end, HORIZON_S, 0.5))
        for stop, start, end in (
            (inner, inner, lesson.until_s),
            (lesson.until_s, 0.0, lesson.until_s),
        )
    ]
    errors = {}
    for settings in itertools.product(DEGREES, THRESHOLDS, SMOOTHED, RIDGES):
        errors[settings] = sum(
            average_errors(
                learn_sparse(lesson, stop, *settings).predict(chosen), chosen
            )[0]
            for stop, chosen in parts
        )
    best = min(errors, key=lambda settings: errors[settings])
    return learn_sparse(lesson, lesson.until_s, *best).predict


# The league

ENTRANTS = {"nominal": use_nominal, "sysid": fit_sysid, "sindy": fit_sindy}
PACKAGES = {"sysid": "plotly", "sindy": "pysindy"}  # which those need
NEAR = 1.05  # ratio to the best error that counts as a shared first place


def hold_league(lesson: Lesson, chosen: Windows, ordered: bool) -> dict[str, Any]:
    """Returns the mean errors [m] and CPU times [s] of all that compete with our model.

    `shuffled_ratio` is how many times the fitted textbook's error is under shuffled commands, or
    under those in order as a control.
    """
    told: dict[str, Any] = {}
    for name, fit in ENTRANTS.items():
        needed = PACKAGES.get(name)
        if needed and find_spec(needed) is None:
            sys.stderr.write(f"{name}: {needed} is not installed; left out.\n")
            continue
        begin = time.process_time()
        predict = fit(lesson)
        seconds = time.process_time() - begin
        error, share, _ = average_errors(predict(chosen), chosen)
        told[name] = {"error_m": error, "share": share, "seconds": seconds}
    ends = lesson.textbook.predict(lesson.drive, chosen)
    textbook = average_errors(ends, chosen)[0]
    recording = lesson.drive.recording
    command = recording.command
    if not ordered:
        order = np.random.default_rng(0).permutation(len(command.t))
        command = replace(command, values=command.values[order])
    shuffled = lesson.drive.part(replace(recording, command=command))
    twist = estimate_twists_at(lesson.drive, chosen.start_t)
    ends = lesson.textbook.predict(shuffled, chosen, twist)
    told["textbook"] = {"error_m": textbook}
    told["shuffled_ratio"] = average_errors(ends, chosen)[0] / textbook
    return told


def average_errors(ends: Array, chosen: Windows) -> tuple[float, float, float]:
    """Returns mean errors: of the position [m], as a share of the path, of the heading [rad]."""
    apart = ends - chosen.end
    error = float(np.hypot(apart[:, 0], apart[:, 1]).mean())
    heading = float(np.abs(geometry.wrap_angle(apart[:, 2])).mean())
    return error, error / float(chosen.path.mean()), heading


def rank_ours(drives: Mapping[str, Any]) -> dict[str, Any]:
    """Returns on how many drives ours is first or near, and its worst ratio to the best."""
    ratios = {}
    for name, told in drives.items():
        rivals = told.get("league", {}).values()
        errors = [each["error_m"] for each in rivals if isinstance(each, dict)]
        if errors:
            ratios[name] = told["error_m"] / min([told["error_m"], *errors])
    if not ratios:
        return {}
    near = sum(ratio <= NEAR for ratio in ratios.values())
    return {
        "ratios": ratios,
        "drives": len(ratios),
        "near": near,
        "worst": max(ratios.values()),
    }
