"""How many steps per second does an environment give, alone and thousands at once?

The navigation task of the differential robot: 10 kinematic substeps per step, a lidar of 720
beams among ten circles, observation, reward, autoreset, random actions. Beside the vector env on
one thread and on all, and the single env of `gymnasium.make` without and with the estimator, two
other simulators do the same task in the same scenes, all timed in turn in the same run.

`times_as_fast_at_equal_work` is our vector env on one thread against them with one scan per
control period, as ours has; `times_as_fast_with_ten_scans` against ten of their own steps, each
of which scans: see measuring/peers.py. (irsim-x can also step many robots at once, but all in one
scene, without a new one as each episode ends.) Bars are ratios within the run: to the peers, to
writing as many bytes as the observations have, and to a step of Gymnasium's CartPole.

With another `--lidar`, as `hokuyo_ust_10lx`, or more `--obstacles`, in a field as crowded, only our
envs are timed, beside the usual one: `share_of_usual` is what is left of its steps per second.
`times_as_long_as_clean` compares a lidar with its copy that has neither noise nor other faults.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from bench import answer, parser_of
from measuring import peers
from numpy.typing import NDArray

from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.faults import LidarFaults
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.sim.world import World

CONTROLS = {
    "slow": "the speed: each env step that counts is ten",
    "standing": "the motion: the robots stand still",
    "blind": "the scan: the lidar has 8 beams",
}
FEW_BEAMS = 8
TIMES_SLOWER = 10
EQUAL_WORK_BARS = {"ir_sim": 900.0, "irsim_x": 70.0}
"""How many times a peer's rate with one scan per control period ours is on one thread, at least."""
WRITE_BAR = 0.01
"""Of the rate at which the observations alone can be written, on one thread."""
SINGLE_BAR, ESTIMATOR_BAR = 0.04, 0.007
"""Of the rate of CartPole, a single env that calculates next to nothing."""
SHARES_OF_USUAL = {"lidar": 0.75, "obstacles": 0.65}
"""Of the env steps per second of the usual env, on one thread, at least."""
CLEAN_BAR = 1.3
SHARES = {
    "share_of_write_limit": "share of the rate at which observations alone can be written",
    "share_of_cartpole": "share of CartPole's rate, single env",
    "share_of_cartpole_with_estimator": "share of CartPole's rate, single env with the estimator",
    "share_of_usual": "left of the usual env's speed",
}
"""In words, for those that miss their bar."""
SCENES = 50
"""That the peers go through, one for each episode."""
ACTIONS = 64
CHUNK = 50
SINGLE_CHUNK = 500
WRITES = 50


@dataclass(frozen=True)
class Case:
    """What is timed; the usual one by default."""

    lidar: str | None = None  # name or file
    obstacles: int = peers.CIRCLES
    control: str | None = None
    clean: bool = False  # without the faults of the lidar

    @property
    def is_usual(self) -> bool:
        """True if peers do the same."""
        return self.lidar is None and self.obstacles == peers.CIRCLES

    @property
    def model(self) -> SimulatorModel:
        """The robot, whose lidar may be next to blind."""
        lidar = peers.MODEL.lidar if self.lidar is None else load_lidar(self.lidar)
        if self.control == "blind":
            lidar = lidar.model_copy(update={"beams": FEW_BEAMS})
        if self.clean:
            lidar = lidar.model_copy(update={"noise_std": 0.0, "faults": LidarFaults()})
        if lidar == peers.MODEL.lidar:
            return peers.MODEL
        return replace(
            peers.MODEL, lidar=lidar, table=bake(lidar, peers.MODEL.table.shapes)
        )

    @property
    def world(self) -> World:
        """The field, as much larger as there are more obstacles."""
        side = (peers.WORLD.size or (0.0,))[0] * (self.obstacles / peers.CIRCLES) ** 0.5
        (group,) = peers.WORLD.obstacles
        more = group.model_copy(update={"count": self.obstacles})
        return peers.WORLD.model_copy(
            update={"size": (side, side), "obstacles": (more,)}
        )


USUAL = Case()


def actions_for(
    space: gymnasium.Space[Any], control: str | None
) -> NDArray[np.float32]:
    """(ACTIONS, ...) random actions, or those of no motion."""
    size = (ACTIONS, *(space.shape or ()))
    if control == "standing":
        low = peers.MODEL.robot.command_low
        high = peers.MODEL.robot.command_high
        return np.broadcast_to(-(low + high) / (high - low), size).astype(np.float32)
    return np.random.default_rng(0).uniform(-1.0, 1.0, size).astype(np.float32)


class Worlds:
    """The vector env at work; `chunk` is a chunk of its steps, `steps` how many env steps."""

    def __init__(self, worlds: int, threads: int, case: Case) -> None:
        further: dict[str, Any] = {} if threads == 1 else {"threads": threads}
        self.model = case.model
        self.env = BridgeVectorEnv(worlds, self.model, case.world, **further)
        self.seen, _ = self.env.reset(seed=0)
        self.actions = actions_for(self.env.action_space, case.control)
        self.times = TIMES_SLOWER if case.control == "slow" else 1
        self.steps = CHUNK * worlds

    def chunk(self) -> None:
        """Steps all worlds."""
        for k in range(CHUNK):
            for _ in range(self.times):
                self.env.step(self.actions[k % ACTIONS])

    def drove(self) -> dict[str, float]:
        """What shows that robots move and see, in one more chunk."""
        beams = self.model.lidar.beams
        moved = 0.0
        changed = 0.0
        episodes = 0
        for k in range(CHUNK):
            was_seen = self.seen
            was = self.env.simulator.data.pose[:, 0, :2].copy()
            self.seen, _, terminated, truncated, _ = self.env.step(
                self.actions[k % ACTIONS]
            )
            episodes += int((terminated | truncated).sum())
            apart = self.env.simulator.data.pose[:, 0, :2] - was
            moved += float(
                np.median(np.hypot(*apart.T))
            )  # not those whose episode began
            changed += np.count_nonzero(self.seen[:, :beams] != was_seen[:, :beams])
        return {
            "moved_m_per_period": moved / CHUNK,
            "beams_changed_per_period": changed / self.steps,
            "episodes": episodes,
        }


class Alone:
    """Likewise the env of `gymnasium.make`, with the wrappers that it adds, reset when it ends."""

    def __init__(self, estimator: bool, case: Case) -> None:
        self.model = case.model
        self.env = gymnasium.make(
            NAVIGATION, model=self.model, world=case.world, estimator=estimator
        )
        self.seen, _ = self.env.reset(seed=0)
        self.actions = actions_for(self.env.action_space, case.control)
        self.times = TIMES_SLOWER if case.control == "slow" else 1
        self.steps = SINGLE_CHUNK

    def chunk(self) -> None:
        """Steps the env."""
        for k in range(SINGLE_CHUNK * self.times):
            _, _, terminated, truncated, _ = self.env.step(self.actions[k % ACTIONS])
            if terminated or truncated:
                self.env.reset()

    def drove(self) -> dict[str, float]:
        """What shows that the robot moves and sees, in one more chunk."""
        beams = self.model.lidar.beams
        moved = 0.0
        changed = 0
        episodes = 0
        was = None
        for k in range(SINGLE_CHUNK):
            was_seen = self.seen
            self.seen, _, terminated, truncated, info = self.env.step(
                self.actions[k % ACTIONS]
            )
            moved += (
                0.0 if was is None else float(np.hypot(*(info["true_pose"] - was)[:2]))
            )
            changed += np.count_nonzero(self.seen[:beams] != was_seen[:beams])
            was = info["true_pose"].copy()
            if terminated or truncated:
                (self.seen, _), was, episodes = self.env.reset(), None, episodes + 1
        return {
            "moved_m_per_period": moved / SINGLE_CHUNK,
            "beams_changed_per_period": changed / SINGLE_CHUNK,
            "episodes": episodes,
        }


def write_chunk(worlds: int, beams: int) -> Callable[[], None]:
    """Writes as many bytes as the observations of some steps have."""
    seen = np.zeros((worlds, beams + 6), np.float32)
    out = np.ones_like(seen)

    def chunk() -> None:
        for _ in range(WRITES):
            np.copyto(out, seen)

    return chunk


def cartpole_chunk() -> Callable[[], None]:
    """Steps of a single env that calculates next to nothing."""
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)

    def chunk() -> None:
        for k in range(SINGLE_CHUNK):
            _, _, terminated, truncated, _ = env.step(k % 2)
            if terminated or truncated:
                env.reset()

    return chunk


def run(
    worlds: int, threads: int, repeats: int, rivals: tuple[str, ...], case: Case
) -> tuple[dict[str, Any], peers.Measured]:
    """All figures; `None` for a peer that can't be installed or was not asked for."""
    register_envs()
    ours: dict[str, Worlds | Alone] = {
        "one": Worlds(worlds, 1, case),
        "all": Worlds(worlds, threads, case),
        "plain": Alone(False, case),
        "estimator": Alone(True, case),
    }
    if not case.is_usual:
        ours["usual"] = Worlds(worlds, 1, USUAL)
    if case.lidar is not None:
        same = None if case.control == "slow" else case.control
        ours["clean"] = Worlds(worlds, 1, replace(case, clean=True, control=same))
    yardsticks = {
        "write": write_chunk(worlds, case.model.lidar.beams),
        "cartpole": cartpole_chunk(),
    }
    calls: dict[str, Callable[[], object]] = {
        name: one.chunk for name, one in ours.items()
    }
    found = peers.measure(
        {**calls, **yardsticks}, rivals, peers.scenes(SCENES), repeats
    )
    rate = {name: one.steps / found.seconds[name] for name, one in ours.items()}
    rate["all"] = ours["all"].steps / found.wall["all"]
    write = WRITES * worlds / found.seconds["write"]
    cartpole = SINGLE_CHUNK / found.seconds["cartpole"]
    whole = {
        name: 1.0 / one["period_with_ten_scans_s"] for name, one in found.peers.items()
    }
    equal = {
        name: 1.0 / one["period_with_one_scan_s"] for name, one in found.peers.items()
    }
    nobody = dict.fromkeys(peers.PEERS)
    result: dict[str, Any] = {
        "times_as_fast_at_equal_work": {
            name: rate["one"] / one for name, one in equal.items()
        },
        "times_as_fast_with_ten_scans": {
            name: rate["one"] / one for name, one in whole.items()
        },
        "single_thread_env_steps_per_s": rate["one"],
        "all_threads_env_steps_per_s": rate["all"],
        "threads": threads,
        "single_env_gym_steps_per_s": rate["plain"],
        "single_env_with_estimator_steps_per_s": rate["estimator"],
        "peers_with_one_scan": {**nobody, **equal},
        "peers": {**nobody, **whole},
        **peers.block_of(found),
        "share_of_write_limit": rate["one"] / write,
        "share_of_cartpole": rate["plain"] / cartpole,
        "share_of_cartpole_with_estimator": rate["estimator"] / cartpole,
        "write_limit_observations_per_s": write,
        "cartpole_steps_per_s": cartpole,
        "drove": {name: one.drove() for name, one in ours.items()},
    }
    if not case.is_usual:
        result["share_of_usual"] = rate["one"] / rate["usual"]
    if case.lidar is not None:
        result["times_as_long_as_clean"] = rate["clean"] / rate["one"]
    return result, found


def judge(
    result: dict[str, Any], found: peers.Measured, case: Case = USUAL
) -> list[str]:
    """The bars that were missed."""
    bars = [
        ("share_of_write_limit", WRITE_BAR),
        ("share_of_cartpole", SINGLE_BAR),
        ("share_of_cartpole_with_estimator", ESTIMATOR_BAR),
    ]
    if not case.is_usual:
        least = [
            each
            for name, each in SHARES_OF_USUAL.items()
            if getattr(case, name) != getattr(USUAL, name)
        ]
        bars = [("share_of_usual", float(np.prod(least)))]
    missed = [
        f"{SHARES[key]}: {100.0 * result[key]:.3g} %, bar {100.0 * bar:g} %"
        for key, bar in bars
        if not result[key] >= bar
    ]
    if not (times := result.get("times_as_long_as_clean", 1.0)) <= CLEAN_BAR:
        missed.append(
            f"times as long as without the lidar's faults: {times:.3f}, bar {CLEAN_BAR}"
        )
    for name, ratio in result["times_as_fast_at_equal_work"].items():
        if not ratio >= (bar := EQUAL_WORK_BARS[name]):
            missed.append(
                f"times as fast as {name} at equal work: {ratio:.0f}, bar {bar:.0f}"
            )
    missed += peers.missed_by(found)
    for name, drove in result["drove"].items():
        missed += peers.missed_by_robots(f"our env {name!r}", drove)
    return missed


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 when a bar is missed."""
    parser = parser_of(__doc__, CONTROLS)
    parser.add_argument("--worlds", type=int, default=2048, help="of the vector env")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--repeats", type=int, default=10, help="timed chunks; thrice if alone"
    )
    parser.add_argument("--lidar", help="name or file of another lidar; without peers")
    parser.add_argument(
        "--obstacles", type=int, default=peers.CIRCLES, help="more; without peers"
    )
    parser.add_argument("--without-peers", action="store_true", help="install nothing")
    given = parser.parse_args()
    case = Case(given.lidar, given.obstacles, given.control)
    rivals = () if given.without_peers or not case.is_usual else tuple(peers.PEERS)
    repeats = (
        given.repeats if rivals else 3 * given.repeats
    )  # a share is told to a few percent
    result, found = run(given.worlds, given.threads, repeats, rivals, case)
    answer(result, judge(result, found, case), given.json)


if __name__ == "__main__":
    main()
