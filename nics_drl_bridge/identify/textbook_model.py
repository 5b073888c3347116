"""A fitted textbook as a Taylor model, which replaces a model that predicts worse."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.identify.calibration import Calibration, Response
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.motion import require_state
from nics_drl_bridge.identify.signals import infer_states
from nics_drl_bridge.identify.yardstick import LIMIT_RANGE, TextbookResponse, Yardstick
from nics_drl_bridge.recording.recording import Samples, Stream
from nics_drl_bridge.robot.curve import InputCurve
from nics_drl_bridge.robot.kinds import has_textbook, textbook
from nics_drl_bridge.robot.spec import POSE_RATES, RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel, evaluate

Powers = NDArray[np.int64]

# ratio of an actuator's range to its maximum on a drive
MARGIN = 1.25
LEAST_COSINE = 0.1  # minimum cosine of a steering angle
WIDEST_ANGLE = 1.4  # maximum angle of a steered wheel in the expansion [rad]
NEGLIGIBLE = 1e-3  # fraction of a rate below which a term of the expansion is left out
# fraction of the widest searched range above which a limit counts as not found
UNLIMITED = 0.5


def make_textbook_calibration(
    yardstick: Yardstick, calibration: Calibration, spec: RobotSpec
) -> Calibration:
    """Returns the calibration of a drive according to the fitted textbook."""
    response = yardstick.response
    x, y, heading = map(float, response.mounting)
    latency = max(response.delay_s, 0.0)
    # motion that precedes its commands has another clock
    early = max(-response.delay_s, 0.0)
    if not spec.state:  # a lag without a state acts as a delay
        used = response.gain.any(axis=1)
        latency += float(response.lag_s[used].mean())
    kept = ("clock_offset_s", "wheel_scale", "turn_scale")
    return replace(
        calibration,
        clock_offset_s=yardstick.clock_offset_s + early,
        command_latency_s=latency,
        rotation_rad=-heading,
        lever_arm_m=(x, y),
        responses=tuple(_update_responses(response, calibration, spec)),
        inputs=tuple(_find_dead_zones(response, spec)),
        uncertainty={k: v for k, v in calibration.uncertainty.items() if k in kept},
    )


def make_textbook_model(
    yardstick: Yardstick, model: TaylorModel, samples: Samples, spec: RobotSpec
) -> TaylorModel | None:
    """Returns the fitted textbook as terms, with the step and range of a model of the same drive.

    Trigonometric functions are expanded over the rows of the samples. None for a state that no
    textbook relates to the twist.
    """
    response = yardstick.response
    book = _Expansion(response, samples, spec, model)
    if not spec.state:
        book.add_twist_of_commands()
    elif [v.name for v in spec.state] == ["wheel_speed", "wheel_angle"]:
        book.add_actuators()
    elif any(v.twist for v in spec.state):
        book.add_twist_as_state()
    elif all(v.follows for v in spec.state):
        book.add_followers()
    elif has_textbook(spec) and not response.bicycle.used:
        book.add_wheels()
    else:
        return None
    return book.made()


def needs_actuators(yardstick: Yardstick, spec: RobotSpec) -> bool:
    """True for a steered robot whose state is its twist: its steering lags, not its turn rate."""
    return yardstick.response.bicycle.used and any(v.twist for v in spec.state)


def make_actuated_spec(yardstick: Yardstick, drive: Drive) -> RobotSpec:
    """Returns a steered robot whose state is its speed and its steering angle."""
    response = yardstick.response
    spec = drive.spec
    speed, steering = _find_bicycle_commands(response)
    speed_gain = abs(float(response.gain[0, speed]))
    angle_gain = abs(float(response.gain[2, steering]))
    largest = np.maximum(spec.command_high, -spec.command_low)
    forward = [v.twist for v in spec.state].index("vx")
    fastest = np.abs(require_state(drive).values[:, forward]).max()
    fastest = max(fastest, speed_gain * largest[speed])
    if spec.command[speed].unit == "m/s":
        fastest = max(fastest, largest[speed])
    sent = np.abs(drive.recording.command.values[:, steering]).max()
    widest = angle_gain * sent + abs(response.offset[2])
    widest = max(widest, angle_gain * largest[steering])
    if spec.command[steering].unit == "rad":
        widest = max(widest, largest[steering])
    states = (
        ("wheel_speed", "m/s", MARGIN * float(fastest), speed),
        ("wheel_angle", "rad", MARGIN * float(widest), steering),
    )
    data = spec.model_dump()
    data["state"] = [
        {
            "name": name,
            "unit": unit,
            "min": -reach,
            "max": reach,
            "follows": spec.command[place].name,
        }
        for name, unit, reach, place in states
    ]
    parameters = {
        "speed_lag": float(response.lag_s[0]),
        "steering_lag": float(response.lag_s[2]),
    }
    # a car commanded by fractions of throttle and steering
    if "speed_gain" in spec.parameters:
        parameters |= {"speed_gain": speed_gain, "greatest_steering": angle_gain}
    data["parameters"] = spec.parameters | parameters
    return RobotSpec.model_validate(data)


def add_actuator_state(
    drive: Drive, spec: RobotSpec, yardstick: Yardstick, calibration: Calibration
) -> Drive:
    """Returns a drive, with known motion, of a robot whose state is speed and steering angle.

    The speed is that of the motion, the angle that of the textbook for the commands.
    """
    response = yardstick.response
    state = require_state(drive)
    forward = [v.twist for v in drive.spec.state].index("vx")
    _, steering = _find_bicycle_commands(response)
    alone = spec.model_copy(update={"state": spec.state[1:]})
    command = drive.recording.command
    lag = response.lag_s[2:]
    latency = calibration.command_latency_s
    angle = infer_states(command, alone, lag, latency, state.t)[:, 0]
    angle = response.gain[2, steering] * angle + response.offset[2]
    speed = state.values[:, forward]
    if response.bicycle.front_drive:
        speed = speed / np.maximum(np.cos(angle), LEAST_COSINE)
    values = np.stack([speed, angle], axis=1)
    recording = replace(drive.recording, state=Stream(state.t, values, state.clock))
    return replace(drive.part(recording), spec=spec)


def _find_bicycle_commands(response: TextbookResponse) -> tuple[int, int]:
    """Returns the indices of speed and steering among the commands of a bicycle."""
    speed = int(np.argmax(np.abs(response.gain[0])))
    return speed, 1 - speed


def _find_actuator(response: TextbookResponse, command: int) -> tuple[int, float]:
    """Returns the row of the actuator that a command moves most, and its gain."""
    actuator = int(np.argmax(np.abs(response.gain[:, command])))
    if response.bicycle.used and actuator == 2:  # the state is the commanded angle
        return actuator, 1.0
    return actuator, float(response.gain[actuator, command])


def _update_responses(
    response: TextbookResponse, calibration: Calibration, spec: RobotSpec
) -> Iterator[Response]:
    names = [c.name for c in spec.command]
    for follower in calibration.responses:
        actuator, gain = _find_actuator(response, names.index(follower.command))
        yield replace(follower, lag_s=float(response.lag_s[actuator]), gain=gain)


def _find_dead_zones(
    response: TextbookResponse, spec: RobotSpec
) -> Iterator[InputCurve]:
    """Yields the dead zone of a speed command whose effect is below, or above, proportional."""
    if not response.bicycle.used or response.offset[0] == 0.0:
        return
    place = int(np.argmax(np.abs(response.gain[0])))
    dead = float(-response.offset[0] / max(abs(response.gain[0, place]), 1e-9))
    yield InputCurve(command=spec.command[place].name, dead=dead)


class _Expansion:
    """Terms of a textbook, by degree of freedom."""

    def __init__(
        self,
        response: TextbookResponse,
        samples: Samples,
        spec: RobotSpec,
        like: TaylorModel,
    ) -> None:
        self.response = response
        self.spec = spec
        self.like = like
        self.x = samples.x
        self.states = len(spec.state)
        self.terms: dict[int, dict[tuple[int, ...], float]] = {
            d: {} for d in range(len(spec.dof_names))
        }
        self.limits = np.tile([-np.inf, np.inf], (self.states, 1))

    def rate_of(self, actuator: int) -> float:
        """Returns the rate [1/s] at which a step of the model brings an actuator to its target."""
        return self.rate_at(float(self.response.lag_s[actuator]))

    def rate_at(self, lag: float) -> float:
        """Returns that rate [1/s] at a lag [s]."""
        dt = self.like.dt
        return (1.0 - float(np.exp(-dt / lag))) / dt

    def unit(self, place: int) -> NDArray[np.int64]:
        """Returns the exponents (V,) of a variable."""
        row = np.zeros(self.x.shape[1], dtype=np.int64)
        row[place] = 1
        return row

    def add(self, dof: int, row: NDArray[np.int64], value: float) -> None:
        """Adds a term to a degree of freedom."""
        key = tuple(row.tolist())
        self.terms[dof][key] = self.terms[dof].get(key, 0.0) + value

    def add_expanded(
        self, dof: int, target: Array, rows: Sequence[NDArray[np.int64]]
    ) -> None:
        """Adds the terms that best approximate a target (T,) over the samples."""
        powers = np.array(rows, dtype=np.int64).reshape(len(rows), self.x.shape[1])
        chi = evaluate(self.x, powers)
        size = np.maximum(np.linalg.norm(chi, axis=0), 1e-12)
        beta = np.linalg.lstsq(chi / size, target, rcond=1e-9)[0]
        shown = np.abs(beta) > NEGLIGIBLE * max(float(np.linalg.norm(target)), 1e-12)
        beta = np.linalg.lstsq((chi / size)[:, shown], target, rcond=1e-9)[0]
        for row, value in zip(powers[shown], beta / size[shown], strict=True):
            self.add(dof, row, float(value))

    def steered_angle(self, steering: Array) -> Array:
        """Returns the angle (T,) of the steered wheel for commanded steering."""
        gain = self.response.gain[2, int(np.argmax(np.abs(self.response.gain[2])))]
        angle = gain * steering + self.response.offset[2]
        return np.asarray(np.clip(angle, -WIDEST_ANGLE, WIDEST_ANGLE))

    def add_bicycle(
        self,
        speed: NDArray[np.int64],
        steering: NDArray[np.int64],
        speeds: Array,
        angles: Array,
        turns: Sequence[NDArray[np.int64]],
    ) -> None:
        """Adds the twist of a bicycle by two variables, for its speeds and angles (T,)."""
        bicycle = self.response.bicycle
        along = speeds
        across = speeds * np.tan(angles)
        if bicycle.front_drive:
            along = speeds * np.cos(angles)
            across = speeds * np.sin(angles)
        length = bicycle.wheelbase * (1.0 + bicycle.understeer * speeds**2)
        self.add_expanded(0, along, [speed, speed + 2 * steering])
        self.add_expanded(2, across / length, turns)

    def add_commanded_bicycle(self, place: int, steering: int, speeds: Array) -> None:
        """Adds the twist of a bicycle by its speed, or its command, and its commanded angle."""
        v = self.unit(place)
        steer = self.unit(steering)
        angles = self.steered_angle(self.x[:, steering])
        turns = [v, v + steer, v + 2 * steer, v + 3 * steer, 3 * v + steer]
        self.add_bicycle(v, steer, speeds, angles, turns)

    def add_follower(self, state: int, rate: float, gains: Array) -> None:
        """Adds the rate of a state that follows the commands by gains (C,)."""
        self.add(3 + state, self.unit(state), -rate)
        for command in np.flatnonzero(gains).tolist():
            row = self.unit(self.states + command)
            self.add(3 + state, row, rate * float(gains[command]))

    def add_twist_of_commands(self) -> None:
        """Adds the twist of a robot without a state."""
        if self.response.bicycle.used:
            speed, steering = _find_bicycle_commands(self.response)
            target = self.response.gain[0, speed] * self.x[:, speed]
            self.add_commanded_bicycle(speed, steering, target)
            return
        for dof, command in np.argwhere(self.response.gain).tolist():
            self.add(dof, self.unit(command), float(self.response.gain[dof, command]))

    def add_twist_as_state(self) -> None:
        """Adds the rates of a robot whose state is its twist."""
        for i, variable in enumerate(self.spec.state):
            if variable.twist is None:
                continue
            part = POSE_RATES.index(variable.twist)
            if part == 1 and not self.spec.moves_sideways:
                continue
            self.add(part, self.unit(i), 1.0)
            self.add_follower(i, self.rate_of(part), self.response.gain[part])
            if part == 0:
                self.limits[i] = self.speed_limits()

    def add_actuators(self) -> None:
        """Adds the rates of a speed and a steering angle, and the twist by them."""
        response = self.response
        is_speed = np.arange(2) == _find_bicycle_commands(response)[0]
        rate = self.rate_of(2)
        self.add_follower(0, self.rate_of(0), np.where(is_speed, response.gain[0], 0.0))
        self.limits[0] = self.speed_limits()
        self.add_follower(1, rate, np.where(is_speed, 0.0, response.gain[2]))
        self.add(4, 0 * self.unit(0), rate * float(response.offset[2]))
        v = self.unit(0)
        angle = self.unit(1)
        turns = [v + angle, 2 * v + angle, 3 * v + angle, v + 3 * angle]
        self.add_bicycle(v, angle, self.x[:, 0], self.x[:, 1], turns)

    def add_followers(self) -> None:
        """Adds the rates of states that follow commands one by one, and the twist by them."""
        names = [c.name for c in self.spec.command]
        follow = [names.index(str(v.follows)) for v in self.spec.state]
        for i, command in enumerate(follow):
            actuator, gain = _find_actuator(self.response, command)
            gains = np.where(np.arange(len(names)) == command, gain, 0.0)
            self.add_follower(i, self.rate_of(actuator), gains)
            if actuator == 0:
                self.limits[i] = self.speed_limits()
            if not self.response.bicycle.used:
                self.add(actuator, self.unit(i), 1.0)
        if self.response.bicycle.used:
            speed, steering = map(follow.index, _find_bicycle_commands(self.response))
            self.add_commanded_bicycle(speed, steering, self.x[:, speed])

    def add_wheels(self) -> None:
        """Adds the rates of wheels, and the twist by them."""
        gain = self.response.gain
        book = textbook(self.spec)
        per_command = book.target(np.eye(len(self.spec.command)))  # (C, S)
        per_wheel = book.twist(np.eye(self.states))  # (S, 3)
        steady = (per_command @ per_wheel).T  # (3, C)
        lag = float(self.response.lag_s[gain.any(axis=1)].mean())
        for wheel in range(self.states):
            self.add_follower(wheel, self.rate_at(lag), per_command[:, wheel])
        for dof in range(3):
            power = float(steady[dof] @ steady[dof])
            if power > 0.0:
                times = float(gain[dof] @ steady[dof]) / power
                for wheel in np.flatnonzero(per_wheel[:, dof]).tolist():
                    share = times * float(per_wheel[wheel, dof])
                    self.add(dof, self.unit(wheel), share)

    def speed_limits(self) -> tuple[float, float]:
        """Returns the maximum fall and rise of the speed, infinite where none was found."""
        rise, fall = map(float, self.response.limit)
        most = UNLIMITED * LIMIT_RANGE[1]
        return -fall if fall < most else -np.inf, rise if rise < most else np.inf

    def made(self) -> TaylorModel:
        """Builds the model."""
        keys = sorted(set().union(*self.terms.values()))
        coefficients = np.zeros((len(self.spec.dof_names), len(keys)))
        for dof, row in self.terms.items():
            for key, value in row.items():
                coefficients[dof, keys.index(key)] = value
        powers = np.array(keys, dtype=np.int64).reshape(len(keys), self.x.shape[1])
        return TaylorModel(
            self.spec.variable_names,
            self.spec.dof_names,
            self.spec.dof_units,
            powers=powers,
            coefficients=coefficients,
            dt=self.like.dt,
            low=self.x.min(axis=0),
            high=self.x.max(axis=0),
            bounded=self.like.bounded,
            inputs=tuple(_find_dead_zones(self.response, self.spec)),
            limits=self.limits,
        )
