"""Speed beside peers: environments, scans among obstacles, nodes of ROS 2.

python benchmarks/speed.py env_throughput | env_scaling
python benchmarks/speed.py lidar_peers
python benchmarks/speed.py ros_lockstep | vehicle_load
"""

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from bench import (
    Bars,
    Benchmark,
    Control,
    Given,
    Result,
    at_least,
    at_most,
    run_benchmark,
)
from measuring import peers
from measuring.rates import interleaved, medians, slowed
from measuring.scenes import BATCH, CIRCLE, Batch, errors
from numpy.typing import NDArray

from nics_drl_bridge import style
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.faults import LidarFaults
from nics_drl_bridge.lidar.scanner import Renderer, Scanner
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.sim.scenes import Scene
from nics_drl_bridge.sim.world import World
from nics_drl_bridge.sim.world_set import AnyWorld

# Environments beside peers

# How many times a peer's rate with one scan per control period ours is on one thread, at least.
AT_EQUAL_WORK = {"ir_sim": 900.0, "irsim_x": 70.0}
SHARES = {
    "share_of_write_limit": at_least(
        0.01, "share of the rate at which observations alone can be written"
    ),
    "share_of_cartpole": at_least(0.1, "share of CartPole's rate, single env"),
    "share_of_cartpole_with_estimator": at_least(
        0.007, "share of CartPole's rate, single env with the estimator"
    ),
}
OF_USUAL = {"lidar": 0.75, "obstacles": 0.65}  # of the usual env's steps per second
CLEAN = at_most(1.3, "times as long as without the lidar's faults")
SCENES = 50  # that the peers go through, one for each episode
ACTIONS = 64
CHUNK = 50
SINGLE_CHUNK = 500


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
        """The robot with the lidar."""
        lidar = peers.MODEL.lidar if self.lidar is None else load_lidar(self.lidar)
        if self.clean:
            lidar = lidar.model_copy(update={"noise_std": 0.0, "faults": LidarFaults()})
        if lidar == peers.MODEL.lidar:
            return peers.MODEL
        table = bake(lidar, peers.MODEL.table.shapes)
        return replace(peers.MODEL, lidar=lidar, table=table)

    @property
    def world(self) -> World:
        """The field, as much larger as there are more obstacles."""
        side = (peers.WORLD.size or (0.0,))[0] * (self.obstacles / peers.CIRCLES) ** 0.5
        (group,) = peers.WORLD.obstacles
        more = group.model_copy(update={"count": self.obstacles})
        changes = {"size": (side, side), "obstacles": (more,)}
        return peers.WORLD.model_copy(update=changes)

    def open_worlds(self, worlds: int, **further: Any) -> "Worlds":
        """Returns a vector env, by default on one thread."""
        return Worlds(BridgeVectorEnv(worlds, self.model, self.world, **further), self)

    def open_alone(self, estimator: bool) -> "Worlds":
        """Returns a single env."""
        about = {"model": self.model, "world": self.world, "estimator": estimator}
        return Alone(gymnasium.make(NAVIGATION, **about), self)

    def make_actions(self, space: gymnasium.Space[Any]) -> NDArray[np.float32]:
        """Returns random actions (ACTIONS, ...), or those of no motion."""
        size = (ACTIONS, *(space.shape or ()))
        if self.control == "standing":
            low = peers.MODEL.robot.command_low
            high = peers.MODEL.robot.command_high
            rest = -(low + high) / (high - low)
            return np.broadcast_to(rest, size).astype(np.float32)
        return np.random.default_rng(0).uniform(-1.0, 1.0, size).astype(np.float32)


class Worlds:
    """The vector env at work."""

    periods = CHUNK  # of a chunk

    def __init__(self, env: Any, case: Case) -> None:
        self.beams = case.model.lidar.beams
        self.env = env
        self.actions = case.make_actions(env.action_space)
        self.take(*env.reset(seed=0))

    def take(self, seen: Any, info: Any) -> None:
        """Keeps what the env tells: observations (N, ...)."""
        self.seen = seen

    @property
    def places(self) -> NDArray[np.float64]:
        """Where the robots are (N, 2) [m]."""
        return np.array(self.env.simulator.data.pose[:, 0, :2])

    @property
    def steps(self) -> int:
        """Of all worlds in a chunk."""
        return self.periods * len(self.seen)

    def step(self, k: int) -> int:
        """Steps all worlds; returns how many episodes ended."""
        seen, _, ended, cut, info = self.env.step(self.actions[k % ACTIONS])
        self.take(seen, info)
        return int(np.count_nonzero(ended | cut))

    def run_chunk(self) -> None:
        """Makes a chunk of steps."""
        for k in range(self.periods):
            self.step(k)


class Alone(Worlds):
    """Likewise the env of `gymnasium.make`, with the wrappers that it adds, reset when it ends."""

    periods = SINGLE_CHUNK

    def take(self, seen: Any, info: Any) -> None:
        """Keeps what the env tells as of one world."""
        self.seen = seen[None]
        self.info = info

    @property
    def places(self) -> NDArray[np.float64]:
        """Where the robot is (1, 2) [m]."""
        return np.array(self.info["true_pose"][None, :2])

    def step(self, k: int) -> int:
        """Steps the env; returns whether an episode ended."""
        ended = super().step(k)
        if ended:
            self.env.reset()
        return ended


def watch_chunk(one: Worlds) -> dict[str, float]:
    """Returns what shows that robots move and see, in one more chunk."""
    moved = 0.0
    changed = 0.0
    episodes = 0
    begun = len(one.seen)
    for k in range(one.periods):
        seen = one.seen[:, : one.beams]
        places = one.places
        ended = one.step(k)
        if begun < len(seen):  # the median leaves out those whose episode began
            moved += float(np.median(np.hypot(*(one.places - places).T)))
        begun = ended
        episodes += ended
        changed += np.count_nonzero(one.seen[:, : one.beams] != seen) / len(seen)
    return {
        "moved_m_per_period": moved / one.periods,
        "beams_changed_per_period": changed / one.periods,
        "episodes": episodes,
    }


def step_cartpole(env: gymnasium.Env[Any, Any]) -> None:
    """Steps a single env that calculates next to nothing."""
    for k in range(SINGLE_CHUNK):
        _, _, ended, cut, _ = env.step(k % 2)
        if ended or cut:
            env.reset()


def measure_throughput(given: Given) -> Result:
    """How many steps per second does an environment give, alone and thousands at once?

    The navigation task of the differential robot: 10 kinematic substeps per step, a lidar of 720
    beams among ten circles, observation, reward, autoreset, random actions. Beside the vector env
    on one thread and on all, and the single env of `gymnasium.make` without and with the
    estimator, two other simulators do the same task in the same scenes, all timed in turn.

    `times_as_fast_at_equal_work` is our vector env on one thread against them with one scan per
    control period, as ours has: see measuring/peers.py. (irsim-x can also step many robots at once,
    but all in one scene, without a new one as each episode ends.) Bars are ratios within the run:
    to the peers, to writing as many bytes as the observations have, and to Gymnasium's CartPole.

    With another `--lidar`, or more `--obstacles`, in a field as crowded, only our envs are timed,
    beside the usual one: `share_of_usual` is what is left of its steps per second.
    `times_as_long_as_clean` compares a lidar with its copy that has neither noise nor other
    faults.
    """
    case = Case(given.lidar, given.obstacles, given.control)
    rivals = () if given.without_peers or not case.is_usual else tuple(peers.PEERS)
    # A share is told to a few percent only by more of them.
    repeats = given.repeats if rivals else 3 * given.repeats
    register_envs()
    ours = {
        "one": case.open_worlds(given.worlds),
        "all": case.open_worlds(given.worlds, threads=given.threads),
        "plain": case.open_alone(estimator=False),
        "estimator": case.open_alone(estimator=True),
    }
    if not case.is_usual:
        ours["usual"] = Case().open_worlds(given.worlds)
    if case.lidar is not None:
        ours["clean"] = replace(case, clean=True).open_worlds(given.worlds)
    cartpole = gymnasium.make("CartPole-v1")
    cartpole.reset(seed=0)
    written = np.zeros((given.worlds, case.model.lidar.beams + 6), np.float32)
    calls: dict[str, Callable[[], object]] = {
        **{name: one.run_chunk for name, one in ours.items()},
        "write": partial(np.copyto, written, np.ones_like(written)),
        "cartpole": partial(step_cartpole, cartpole),
    }
    for name in ("one", "all", "plain", "estimator"):
        calls[name] = slowed(calls[name], case.control)
    found = peers.measure(calls, rivals, peers.make_scenes(SCENES), repeats)
    rate = {name: one.steps / found.seconds[name] for name, one in ours.items()}
    rate["all"] = ours["all"].steps / found.wall["all"]
    write = given.worlds / found.seconds["write"]
    step = SINGLE_CHUNK / found.seconds["cartpole"]
    result: Result = {
        "single_thread_env_steps_per_s": rate["one"],
        "all_threads_env_steps_per_s": rate["all"],
        "threads": given.threads,
        "single_env_gym_steps_per_s": rate["plain"],
        "single_env_with_estimator_steps_per_s": rate["estimator"],
        **found.describe(),
        "share_of_write_limit": rate["one"] / write,
        "share_of_cartpole": rate["plain"] / step,
        "share_of_cartpole_with_estimator": rate["estimator"] / step,
        "drove": {name: watch_chunk(one) for name, one in ours.items()},
    }
    result["times_as_fast_at_equal_work"] = {
        name: rate["one"] * one["period_s"] for name, one in found.peers.items()
    }
    if not case.is_usual:
        result["share_of_usual"] = rate["one"] / rate["usual"]
        changed = "lidar" if case.lidar else "obstacles"
        result["least_share_of_usual"] = OF_USUAL[changed]
    if case.lidar is not None:
        result["times_as_long_as_clean"] = rate["clean"] / rate["one"]
    return result


def set_throughput_bars(result: Result) -> Bars:
    bars: dict[str, Any] = dict(SHARES)
    if "share_of_usual" in result:
        left = "left of the usual env's speed"
        bars = {"share_of_usual": at_least(result["least_share_of_usual"], left)}
    if "times_as_long_as_clean" in result:
        bars["times_as_long_as_clean"] = CLEAN
    drove = {"drove": {"*": peers.DRIVEN}}
    return bars | drove | set_peer_bars(result, AT_EQUAL_WORK)


def set_peer_bars(result: Result, least: Mapping[str, float]) -> Bars:
    """Returns bars of how many times as fast as the peers we are at least, and of what they did."""
    ratios = result["times_as_fast_at_equal_work"]
    faster = {name: at_least(least[name]) for name in ratios}
    return {"times_as_fast_at_equal_work": faster} | peers.set_bars(result)


# Environments as something grows

MOST_TIMES = {"worlds": 0.5, "robots": 4.0, "obstacles": 12.0, "beams": 12.0}
WORLDS = 256
OBSTACLES = 10
SIDE = 8.0
BEAMS = 720
SWEEPS: dict[str, tuple[int, ...]] = {
    "worlds": (1, 4, 16, 64, 256, 1024, 4096, 16384),
    "robots": (1, 2, 4, 8, 16, 32, 64),
    "obstacles": (1, 4, 16, 64, 256),
    "beams": (36, 90, 180, 360, 720, 1440, 2048),
}
AREA_PER_ROBOT = 12.0  # [m^2]
AREA_PER_OBSTACLE = 4.0  # [m^2]
FEWEST = 40  # steps of which the median is taken, at least, unless fewer are asked for
ROBOT_STEPS = 256  # robots of all worlds together while their number in each grows


@dataclass(frozen=True)
class Crowd(Navigation):
    """The navigation task for each of several robots, which see each other by lidar alone.

    So the observation of a robot is as long in a world of 64 as in a world of its own.
    """

    team: int = 1

    @property
    def robots(self) -> int:
        """M."""
        return self.team


def make_field(obstacles: int, side: float) -> World:
    """Returns a square field of `side` [m] with so many circles."""
    circles = {"shapes": [{"kind": "circle", "radius": peers.RADIUS}], "gap": 0.0}
    return World.model_validate(
        {
            "name": "field",
            "size": (side, side),
            "obstacles": [{**circles, "count": obstacles}],
            "clearance": 0.3,
            "goal_distance": (1.0, side),
        }
    )


def make_env(
    worlds: int = WORLDS,
    robots: int = 1,
    world: AnyWorld | None = None,
    beams: int = BEAMS,
) -> BridgeVectorEnv:
    """Returns worlds of robots that have to reach goals."""
    model = peers.MODEL
    if beams != model.lidar.beams:
        changed = model.lidar.model_copy(update={"beams": beams})
        lidar = LidarSpec.model_validate(changed.model_dump())
        model = replace(model, lidar=lidar, table=bake(lidar, model.table.shapes))
    return BridgeVectorEnv(
        worlds,
        model,
        world or make_field(OBSTACLES, SIDE),
        task=Crowd,
        task_options={"team": robots},
        copy=False,
        max_episode_steps=300,
    )


def make_point(name: str, value: int) -> BridgeVectorEnv:
    """Returns the environment of one point of a curve."""
    if name == "worlds":
        return make_env(value)
    if name == "robots":
        side = max(SIDE, math.sqrt(value * AREA_PER_ROBOT))
        field = make_field(OBSTACLES, side)
        return make_env(max(1, ROBOT_STEPS // value), value, field)
    if name == "obstacles":
        side = max(SIDE, math.sqrt(value * AREA_PER_OBSTACLE))
        return make_env(world=make_field(value, side))
    return make_env(beams=value)


def make_stepper(env: BridgeVectorEnv, in_pairs: bool) -> Callable[[], None]:
    """Returns a call that steps an environment, by the same random actions again and again.

    Args:
        env: which.
        in_pairs: whether each robot of a world looks at each other in each substep, one by one.
    """
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = cycle([env.action_space.sample() for _ in range(16)])
    looks = env.model.timing[1] if in_pairs and env.robots > 1 else 0

    def step() -> None:
        env.step(next(actions))
        for _ in range(looks):
            for world in env.simulator.data.pose[:, :, :2].tolist():
                min(math.dist(one, other) for one in world for other in world)

    return step


def measure_curve(
    name: str, values: Sequence[int], repeats: int, in_pairs: bool
) -> list[float]:
    """Returns the cost of an env step at each point of a curve [us]."""
    costs = []
    for value in values:
        env = make_point(name, value)
        often = max(min(repeats, FEWEST), repeats // env.num_envs)
        calls = {value: make_stepper(env, in_pairs)}
        seconds = medians(interleaved(calls, often, clock=time.process_time))
        costs.append(1e6 * seconds[value] / env.num_envs)
        env.close()
    return costs


def measure_scaling(given: Given) -> Result:
    """What does an env step cost with more worlds, robots, obstacles, beams, and worlds in a set?

    Navigation on one thread: differential robots, 10 kinematic substeps, observation, reward and
    autoreset, random actions. Unless it is what grows: 256 worlds of one robot, 10 circles on
    8 x 8 m, 720 beams. Robots and obstacles get a field that grows with them, so that as many as
    before are in range; what then grows faster than their number is the search for them.
    """
    result: Result = {}
    for name, sizes in SWEEPS.items():
        result[name] = [sizes[0], sizes[-1]] if given.ends_only else list(sizes)
        result[f"{name}_us"] = measure_curve(
            name, result[name], given.repeats, given.control == "quadratic"
        )
    per_robot = np.array(result["robots_us"]) / np.array(result["robots"])
    result["robots_us_per_robot"] = per_robot.tolist()
    costs = {name: _costs_of(result, name) for name in SWEEPS}
    result["end_to_end"] = {name: each[-1] / each[0] for name, each in costs.items()}
    if given.picture:
        draw_curves(result, given.picture)
    return result


def _costs_of(result: Result, name: str) -> list[float]:
    return result["robots_us_per_robot" if name == "robots" else f"{name}_us"]


def set_scaling_bars(result: Result) -> Bars:
    bars = {
        name: at_most(most, f"{name}: {result[name][-1]} cost, times {result[name][0]}")
        for name, most in MOST_TIMES.items()
    }
    return {"end_to_end": bars}


def draw_curves(result: Result, file: Path) -> None:
    """Draws the curves side by side, on logarithmic axes."""
    figure, grid = style.make_panels(1, len(SWEEPS), (12.0, 3.2), sharey=True)
    for axes, name in zip(grid, SWEEPS, strict=True):
        axes.loglog(result[name], _costs_of(result, name), "o-")
        axes.set_xlabel(name)
        axes.set_ylabel(f"us per {'robot and' if name == 'robots' else 'env'} step")
        axes.grid(visible=True, which="both")
    write_bytes(file, style.render_png(figure))


# Scans beside peers

SCANS_AT_EQUAL_WORK = {"ir_sim": 2500.0, "irsim_x": 15.0}
SCANS_WRITTEN = at_least(0.02, "share of the rate at which ranges can be written")
# Against our exact scan [m]; the circles of ir-sim are polygons.
SCAN_RMSE_M = {"baked": 0.01, "ir_sim": 0.03, "irsim_x": 0.01}
HALF = 0.5 * peers.MODEL.lidar.angle_increment
# Their beams are spread from the first to the last symmetrically; so are these, full circle or not.
SPREAD = LidarSpec.model_validate(
    {
        **peers.MODEL.lidar.model_dump(),
        "angle_min": peers.MODEL.lidar.angle_min + HALF,
        "angle_max": peers.MODEL.lidar.angle_max + HALF,
    }
)


def place_scans(drawn: list[Scene], turned: float = 0.0) -> Batch:
    """Returns a scan at the start of each scene, every lidar turned [rad]."""
    starts = np.array([scene.starts[0] for scene in drawn])
    poses = np.zeros((len(drawn), len(drawn[0].bodies), 3))
    poses[..., :2] = [scene.bodies[:, :2] for scene in drawn]
    circles = (CIRCLE,) * poses.shape[1]
    return Batch(circles, poses, starts + np.array([0.0, 0.0, turned]))


def prepare_scan(
    batch: Batch, table: LidarTable, renderer: Renderer
) -> Callable[[], Any]:
    """Returns a call that renders a batch among the walls and returns its ranges (N, B) [m]."""
    scanner = Scanner(SPREAD, table, renderer)
    scene = (batch.bodies(scanner), peers.WORLD.all_walls())
    out = np.empty((len(batch.lidar), SPREAD.beams), np.float32)
    return partial(scanner.scan, batch.lidar, *scene, out=out)


def measure_lidar_peers(given: Given) -> Result:
    """How fast are other simulators at the same scan: 720 beams among ten circles and four walls?

    ir-sim and irsim-x scan at the starts of the scenes of env_throughput, as the scanner does,
    exact and baked, and every scan is compared with our exact one. What is timed is a scan alone,
    the very call that their step makes, in turn with ours: `times_as_fast_at_equal_work`.
    """
    rivals = () if given.without_peers else tuple(peers.PEERS)
    table = bake(SPREAD, (CIRCLE,))
    batch = place_scans(peers.make_scenes(given.scans))
    calls = {
        name: slowed(prepare_scan(batch, table, name), given.control)
        for name in ("baked", "exact")
    }
    written = np.empty((given.scans, SPREAD.beams), np.float32)
    calls["write"] = partial(written.fill, 1.0)
    drawn = peers.make_scenes(given.scenes)
    found = peers.measure(calls, rivals, drawn, given.repeats)
    rate = {name: given.scans / seconds for name, seconds in found.seconds.items()}
    theirs = {name: 1.0 / one["scan_s"] for name, one in found.peers.items()}
    turned = SPREAD.angle_increment if given.control == "shifted" else 0.0
    exact = prepare_scan(place_scans(drawn, turned), table, "exact")()
    baked = prepare_scan(place_scans(drawn), table, "baked")()
    ranges = {"baked": baked, **found.ranges}
    return {
        "times_as_fast_at_equal_work": {
            name: rate["baked"] / one for name, one in theirs.items()
        },
        "baked": rate["baked"],
        "exact": rate["exact"],
        **theirs,
        "rmse_m": {name: errors([each], [exact])[0] for name, each in ranges.items()},
        **found.describe(),
        "share_of_write_limit": rate["baked"] / rate["write"],
    }


def set_lidar_bars(result: Result) -> Bars:
    return {
        "share_of_write_limit": SCANS_WRITTEN,
        "rmse_m": {name: at_most(SCAN_RMSE_M[name]) for name in result["rmse_m"]},
        **set_peer_bars(result, SCANS_AT_EQUAL_WORK),
    }


# Steps over ROS 2

LOCKSTEP_BARS = {
    "ratio": at_least(0.5),
    "driven_m": at_least(0.1),
}


def measure_lockstep(given: Given) -> Result:
    """How many env steps per second go over ROS 2 in lock-step, beside a bare pair of nodes?

    The env is that of `gymnasium.make`: a command to a simulator node in a process of its own, its
    720-beam scan among ten obstacles and its odometry back, the estimator, observation and reward.
    The bare echo is what ROS 2 itself allows: two processes of rclpy's own executor, by the
    transports that it chooses, that exchange the same messages, made once, and do nothing else.
    Both are measured in turns, chunk by chunk, so that what else the machine does falls on both.
    """
    from measuring.echoes import measure_in_turns

    return measure_in_turns(given.chunks, given.size, given.control)


# What the nodes take on a vehicle

VEHICLE_BARS = {
    "cores": at_most(0.25, "least share of a core"),
    "p99_ms": at_most(10.0, "p99 [ms]"),
    "memory_mb": at_most(250.0, "memory [MB]"),
    "median_ms": at_most(50.0, "median [ms]"),
}
SLOW_POLICY = """
import time
from nics_drl_bridge.policy.file.policy_file import PolicyFile
act = PolicyFile.act
PolicyFile.act = lambda self, seen: time.sleep(0.06) or act(self, seen)
from"""


def measure_vehicle(given: Given) -> Result:
    """What do middleware, policy and gate take of a core, and how soon do they answer a scan?

    What `nics doctor --load` measures: the real nodes on one core, half of it and a quarter, beside
    a robot that publishes scans of 720 beams and odometry, both at 10 or 20 Hz, over DDS. The bars
    of p99 (to `cmd_vel_raw`) and memory are for a quarter of a core at 20 Hz, that of the median
    for a core at 10 Hz.
    """
    from nics_drl_bridge.nodes import load, processes

    if given.control == "slow":
        make_command = processes.make_module_command
        processes.make_module_command = lambda module: [
            word.replace("; from", SLOW_POLICY) for word in make_command(module)
        ]
    loads, _ = load.measure_load(peers.MODEL, "differential", given.seconds)
    hardest = loads[-1]
    return {
        "rows": {f"{100 * row.cores:g}_{row.rate:g}": asdict(row) for row in loads},
        "cores": hardest.cores,
        "p99_ms": hardest.policy.p99_ms,
        "memory_mb": sum(hardest.memory_mb.values()),
        "median_ms": loads[0].policy.median_ms,
    }


REPEATED = (10, "timed rounds")
WITHOUT_PEERS = (False, "install nothing")
BENCHMARKS = {
    "env_throughput": Benchmark(
        measure_throughput,
        set_throughput_bars,
        {
            "slow": Control("the speed: each step is made ten times", "share of"),
            "standing": Control(
                "the motion: the robots stand still",
                "drove: one: moved_m_per_period",
            ),
        },
        {
            "worlds": (2048, "of the vector env"),
            "threads": os.cpu_count() or 1,
            "repeats": REPEATED,
            "lidar": {"help": "name or file of another lidar; without peers"},
            "obstacles": (peers.CIRCLES, "no peers"),
            "without-peers": WITHOUT_PEERS,
        },
        short="--worlds 64 --threads 1 --repeats 1 --without-peers",
        unsettled=("share of ", "left of ", "times as long"),
    ),
    "env_scaling": Benchmark(
        measure_scaling,
        set_scaling_bars,
        {
            "quadratic": Control(
                "the search for what is near: each robot looks at each other, in Python",
                "robots: 64 cost",
            ),
        },
        {
            "repeats": (20_000, "env steps of a point"),
            "picture": {"type": Path, "help": "draw the curves into this file"},
            "ends-only": (False, "two points of each curve"),
        },
        short="--ends-only --repeats 5",
        unsettled=(" cost",),
    ),
    "lidar_peers": Benchmark(
        measure_lidar_peers,
        set_lidar_bars,
        {
            "shifted": Control(
                "the same scan: the exact one is turned by one beam", "rmse_m: baked"
            ),
            "slow": Control("the speed: each scan is made ten times", "share of"),
        },
        {
            "scans": (BATCH, "of one of our batches"),
            "scenes": (50, "for the peers"),
            "repeats": REPEATED,
            "without-peers": WITHOUT_PEERS,
        },
        short="--scans 64 --scenes 4 --repeats 2 --without-peers",
        unsettled=("share of",),
    ),
    "ros_lockstep": Benchmark(
        measure_lockstep,
        LOCKSTEP_BARS,
        {
            "slow": Control("speed: a step rests", "ratio 0."),
            "standing": Control("the commands: the robot does not drive", "driven_m 0"),
        },
        {
            "chunks": 150,
            "size": (100, "steps in a chunk"),
        },
        short="--chunks 2 --size 20",
        unsettled=("ratio",),
        needs=("rclpy",),
    ),
    "vehicle_load": Benchmark(
        measure_vehicle,
        VEHICLE_BARS,
        {"slow": Control("speed: the policy node rests before it answers", "median")},
        {"seconds": (60.0, "of each share of a core and rate")},
        short="--seconds 3",
        unsettled=("p99", "memory", "least share"),
        needs=("rclpy",),
    ),
}

if __name__ == "__main__":
    run_benchmark(BENCHMARKS)
