"""Adversarial policies on three robots among static obstacles: does any touch one?

The whole gate decides, at every control period of the simulator, on the scan that the simulator
makes. Latency and deceleration of each robot are measured first, by braking in the same simulator.
An adversary knows the true scene and tries hard: it rams the nearest thing, grazes it, turns into
it at the last moment, or jerks the robot about. A part of the episodes is driven again without the
shield, to show that the adversaries are some.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass

import numpy as np
from measuring.gates import Gate, gate_config
from numpy.typing import NDArray

from nics_drl_bridge import geometry
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.lidar.shapes import RADIUS, X, Y
from nics_drl_bridge.safety.state import ShieldConfig
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.space_kernels import wall_distance
from nics_drl_bridge.sim.world import load_world

Array = NDArray[np.float64]
ROBOTS = ("ackermann", "differential", "mecanum")
ROUND = [X, Y, RADIUS]
"""All that there is to know about a round body."""
ADVERSARIES = ("ram", "graze", "late", "jerk")
WORLDS, STEPS, MARGIN = 50, 60, 0.05
SPEEDS = (1.0, 0.5)
SAFETY = 1.1
"""By which the measured latency is taken to be longer."""
HORIZON_S = (0.3, 1.0)
TRIES = 12
GRAZE = 0.01
"""So deep does the grazing adversary want to be in what it grazes [m]."""
CONTROL_SHARE = 10
"""One in so many batches is driven without the shield as well."""


@dataclass(frozen=True)
class Braking:
    """How a robot stops: distance = speed latency + speed^2 / (2 deceleration)."""

    latency_s: float
    deceleration: float


def measure_braking(model: SimulatorModel) -> Braking:
    """Drives straight at two speeds in each direction, lets go, and measures the way to rest."""
    sim = FastSimulator(model, load_world("empty"))
    worst = Braking(0.0, 1e3)
    for i, variable in enumerate(model.robot.command):
        for end in (variable.min, variable.max):
            if variable.unit != "m/s" or end == 0.0:
                continue
            far, near = (_stopping_distance(sim, i, share * end) for share in SPEEDS)
            curved, speed = far - 2.0 * near, abs(end)
            deceleration = speed**2 / (4.0 * curved) if curved > 1e-4 else 1e3
            latency = (far - speed**2 / (2.0 * deceleration)) / speed
            worst = Braking(
                max(worst.latency_s, SAFETY * latency), min(worst.deceleration, deceleration)
            )
    return worst


def _stopping_distance(sim: FastSimulator, index: int, speed: float) -> float:
    command = np.zeros((1, 1, len(sim.model.robot.command)))
    sim.reset([0], starts=np.array([[[-np.sign(speed), 0.0, 0.0]]]))
    command[..., index] = speed
    for _ in range(12):
        sim.step(command)
    path = 0.0
    for _ in range(12):
        before = sim.data.pose[0, 0].copy()
        sim.step(0.0 * command)
        path += float(np.linalg.norm(geometry.between(before, sim.data.pose[0, 0])[:2]))
    return path


class Adversary:
    """Picks, among some commands, the one that is worst by its own lights.

    Args:
        kind: which of the adversaries.
        model: of the robot.
        rng: draws the commands.
    """

    def __init__(self, kind: str, model: SimulatorModel, rng: np.random.Generator) -> None:
        self._kind, self._robot, self._rng = kind, model.robot, rng
        self._wheelbase = model.robot.parameters.get("wheelbase", 0.0)
        self._held, self._left = np.zeros(len(model.robot.command)), 0

    def act(self, pose: Array, circles: Array, walls: Array) -> Array:
        """The command (C,) for a true pose (3,), obstacles (K, 3) and walls (W, 4)."""
        low, high = self._robot.command_low, self._robot.command_high
        ends = np.where(self._rng.random((TRIES, len(low))) < 0.5, low, high)
        tries = np.concatenate([ends, self._rng.uniform(low, high, (TRIES, len(low)))])
        if self._kind == "jerk":
            return self._hold(ends[0])
        if self._kind == "late":  # away from everything for a while, then into the nearest
            self._left = self._left - 1 if self._left > 0 else int(self._rng.integers(2, 15))
            sign = -1.0 if self._left > 2 else 1.0
        else:
            sign = 1.0
        least = self._nearest(pose, tries, circles, walls)
        if self._kind == "graze":
            return np.asarray(tries[int(np.argmin(np.abs(least + GRAZE)))])
        return np.asarray(tries[int(np.argmin(sign * least))])

    def _hold(self, wish: Array) -> Array:
        if self._left == 0:
            self._held, self._left = wish, int(self._rng.integers(1, 8))
        self._left -= 1
        return self._held

    def _nearest(self, pose: Array, commands: Array, circles: Array, walls: Array) -> Array:
        """(n,) clearances [m] that commands (n, C) lead to, at the end or on the way."""
        twist = self._robot.to_cmd_vel(commands)
        if self._wheelbase > 0.0:
            twist[:, 2] = twist[:, 0] * np.tan(twist[:, 2]) / self._wheelbase
        moved = geometry.exp(np.multiply.outer(np.array(HORIZON_S), twist))
        places = geometry.compose(pose, moved)[..., :2]
        away = np.array([[wall_distance(x, y, walls) for x, y in row] for row in places])
        for x, y, radius in circles:
            away = np.minimum(away, np.hypot(places[..., 0] - x, places[..., 1] - y) - radius)
        return np.asarray(away.min(axis=0) - self._robot.footprint_radius)


@dataclass(frozen=True)
class Outcome:
    """What happened in some episodes.

    Attributes:
        contacts: robots that touched something.
        path: driven by all of them [m].
        latched: gates that latched a stop, and so did not put the shield to a test any more.
    """

    contacts: int
    path: float
    latched: int


def episodes(model: SimulatorModel, braking: Braking | None, seeds: list[int]) -> Outcome:
    """Drives one episode per seed, side by side; without braking, without a shield."""
    period, robot, lidar = model.control_period, model.robot, model.lidar
    sim = FastSimulator(model, load_world("arena"), worlds=len(seeds))
    walls = sim.world.all_walls()
    shield = None
    if braking is not None:
        shield = ShieldConfig(
            braking.latency_s, braking.deceleration, MARGIN, period, robot.footprint_radius,
            robot.parameters.get("wheelbase", 0.0),
        )  # fmt: skip
    scenes = sim.reset(seeds)
    gates = [Gate(gate_config(robot, lidar, shield=shield), lidar) for _ in seeds]
    rngs = [np.random.default_rng([7, seed]) for seed in seeds]
    foes = [
        Adversary(ADVERSARIES[seed % len(ADVERSARIES)], model, rng)
        for seed, rng in zip(seeds, rngs, strict=True)
    ]
    for n, gate in enumerate(gates):
        gate.arm(sim.data.ranges[n, 0], sim.data.odom[n, 0])
    commands, path = np.zeros((len(seeds), 1, len(robot.command))), 0.0
    for _ in range(STEPS):
        for n, (gate, foe, scene) in enumerate(zip(gates, foes, scenes, strict=True)):
            gate.now += period
            gate.sense(sim.data.ranges[n, 0], sim.data.odom[n, 0], sim.data.twist[n, 0])
            wish = foe.act(sim.data.pose[n, 0], scene.bodies[:, ROUND], walls)
            gate.command(robot.to_cmd_vel(wish))
            commands[n, 0] = robot.from_cmd_vel(gate.tick().twist)
        before = sim.data.pose[:, 0].copy()
        sim.step(commands)
        path += float(np.linalg.norm(sim.data.pose[:, 0, :2] - before[:, :2], axis=1).sum())
    latched = sum(gate.state.latched is not None for gate in gates)
    return Outcome(int((sim.data.collided > 0).sum()), path, latched)


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 after a contact."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    total = {"contacts": 0, "path_m": 0.0, "latched": 0, "tried_without": 0, "contacts_without": 0}
    for index, name in enumerate(ROBOTS):
        model = builtin_model(name)
        braking = measure_braking(model)
        count = given.episodes // len(ROBOTS) + (index < given.episodes % len(ROBOTS))
        first = given.seed + index * given.episodes
        batches = [
            list(range(begin, min(begin + WORLDS, first + count)))
            for begin in range(first, first + count, WORLDS)
        ]
        shielded = [episodes(model, braking, seeds) for seeds in batches]
        bare = [episodes(model, None, seeds) for seeds in batches[::CONTROL_SHARE]]
        row = {
            "contacts": sum(one.contacts for one in shielded),
            "path_m": round(sum(one.path for one in shielded), 1),
            "latched": sum(one.latched for one in shielded),
            "tried_without": sum(len(seeds) for seeds in batches[::CONTROL_SHARE]),
            "contacts_without": sum(one.contacts for one in bare),
        }
        total = {key: total[key] + value for key, value in row.items()}
        if not given.json:
            sys.stdout.write(
                f"{name:<14}latency {braking.latency_s:.3f} s, deceleration "
                f"{braking.deceleration:.1f} m/s^2; {count} episodes over {row['path_m']} m: "
                f"{row['contacts']} contacts, {row['latched']} latched stops; without the shield "
                f"{row['contacts_without']} in {row['tried_without']}\n"
            )
            sys.stdout.flush()
    if given.json:
        sys.stdout.write(json.dumps({"episodes": given.episodes, **total}) + "\n")
    raise SystemExit(1 if total["contacts"] else 0)


if __name__ == "__main__":
    main()
