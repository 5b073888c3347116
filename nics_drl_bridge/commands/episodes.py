"""Drives the same episodes in process, over DDS, in MuJoCo and on the vehicle, as in Fig. 7."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib import import_module
from math import isnan
from pathlib import Path
from typing import Any

import gymnasium

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands.vehicle_goals import NEAR_M, GoalOrder, VehicleEpisode
from nics_drl_bridge.config import list_shipped
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.env.sim_backend import make_backend
from nics_drl_bridge.errors import BackendError, ConfigError, suggest
from nics_drl_bridge.files import format_json, write_bytes, write_text
from nics_drl_bridge.gate.gated_backend import GatedBackend
from nics_drl_bridge.generator import SimulatorModel, open_model, save_model
from nics_drl_bridge.interface import Array, Backend
from nics_drl_bridge.policy import evaluation
from nics_drl_bridge.policy.evaluation import Episode, Tally, drive, drive_all
from nics_drl_bridge.policy.file.contract import Contract
from nics_drl_bridge.policy.file.stateful import Policy
from nics_drl_bridge.policy.policies import is_policy_file, open_policy
from nics_drl_bridge.policy.train.settings import find_pace
from nics_drl_bridge.report.doctor import examine
from nics_drl_bridge.report.doctor_facts import derive_expected
from nics_drl_bridge.report.pictures import draw_trajectories
from nics_drl_bridge.robot import DEFAULT_ROBOT
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.seeds import check_seeds
from nics_drl_bridge.sim.randomisation import Randomisation, load_randomisation
from nics_drl_bridge.sim.scenes import Scene, sample_scene
from nics_drl_bridge.sim.world_set import AnyWorld, load_worlds

FAST = "fast"
DDS = "dds"
MUJOCO = "mujoco_dds"
DART = "dart_dds"
VEHICLE = "vehicle"
NODES = {DDS: "simulator_node", MUJOCO: "mujoco_node", DART: "dart_node"}
PLACES = (FAST, *NODES)
BY_DEFAULT = (FAST, DDS, MUJOCO)  # if one is unavailable, so are the later ones
LABELS = {
    FAST: "in process",
    DDS: "over DDS",
    MUJOCO: "MuJoCo over DDS",
    DART: "DART over DDS",
    VEHICLE: "on the vehicle",
}
EVALUATION = "evaluation.json"
GATE = "command_gate"
RAW = "cmd_vel_raw"
ARM_S = 60.0
# time for a node to start [s]; it may have to compile its kernels
START_S = 180.0
EPISODE_PANELS = 6
HEADS = (
    "policy",
    "world",
    "success",
    "95 %",
    "believed",
    "collision",
    "time-out",
    "path [m]",
    "time [s]",
    "as in the first",
    "deviation [m]",
    "greatest [m]",
)
Say = Callable[[str], None]
Tell = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Conditions:
    """Conditions of an evaluation; by default the model's lidar, no randomisation and no gate."""

    lidar: str | None = None  # shipped lidar or YAML file; None: the model's
    # shipped randomisation or YAML file, drawn for each episode
    randomisation: str | None = None
    # limits of a gate between policy and robot: shipped, or a YAML file
    gate: str | None = None
    # time limit of an episode [steps]; None: from policies, robot and world
    steps: int | None = None
    # overrides of the policy's task options
    task: Mapping[str, Any] = field(default_factory=dict)
    # path/to/file.py:ClassName of the policy's task, if it is not shipped
    kind: str | None = None

    @property
    def ranges(self) -> Randomisation | None:
        """Ranges that each episode draws from. Raises ConfigError."""
        if self.randomisation is None:
            return None
        return load_randomisation(self.randomisation)

    def model(self, name: str, folder: Path) -> tuple[SimulatorModel, str]:
        """Opens a model; returns it and its name. Saves it below a folder if the lidar differs."""
        model = open_model(name, self.lidar)
        if self.lidar is None:
            return model, name
        place = folder / "model"
        save_model(model, place)
        return open_model(place), str(place)


NO_CONDITIONS = Conditions()


def drive_in(
    place: str,
    policy: str,
    name: str,
    world: str,
    seeds: Sequence[int],
    logs: Path,
    on_episode: Callable[[Episode], None],
    say: Say = lambda _: None,
    conditions: Conditions = NO_CONDITIONS,
) -> list[Episode]:
    """Drives episodes in one of `PLACES` with the model `name`; ends the node that it starts.

    Raises BridgeError.
    """
    model = open_model(name)
    check_place(place, model.robot)
    ranges = conditions.ranges
    if place == FAST:
        options: dict[str, Any] = {"estimator": True, "randomisation": ranges}
        env, opened = open_env(policy, model, world, "sim", conditions, **options)
        with closing(env):
            return drive_all(env, opened, seeds, on_episode)
    from nics_drl_bridge.nodes.operator import Witness
    from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

    node = NODES[place]
    domain_id = choose_domain_id()
    parameters = {
        "model": name,
        "world": world,
        "mode": "lockstep",
        "randomisation": conditions.randomisation or "",
    }
    options = {
        "domain_id": domain_id,
        "simulator": node,
        "timeout_s": START_S,
        "truth": True,
        "randomisation": ranges,
    }
    with (
        NodeProcess(node, logs, parameters, domain_id) as process,
        Witness(domain_id) as witness,
    ):
        say(f"started {node} as process {process.pid} in ROS domain {domain_id}")
        try:
            env, opened = open_env(policy, model, world, "dds", conditions, **options)
            with closing(env):
                touched = partial(witness.touched, node, START_S)
                return drive_all(env, opened, seeds, on_episode, touched)
        except BackendError:
            process.check()  # If the node has ended, its own error is more useful.
            raise


def open_env(
    policy: str,
    model: SimulatorModel,
    world: str | AnyWorld,
    backend: str,
    conditions: Conditions = NO_CONDITIONS,
    **options: Any,
) -> tuple[gymnasium.Env[Any, Any], Policy]:
    """Makes the env of a policy's task on a named backend; opens the policy."""
    opened_world = load_worlds(world) if isinstance(world, str) else world
    backend_options = {name: v for name, v in options.items() if v is not None}
    driven = make_backend(backend, model, opened_world, **backend_options)
    if conditions.gate is not None:
        driven = GatedBackend(driven, model, conditions.gate)
    return make_env(driven, policy, model, opened_world, conditions)


def make_env(
    backend: Backend,
    policy: str,
    model: SimulatorModel,
    world: AnyWorld,
    conditions: Conditions,
) -> tuple[gymnasium.Env[Any, Any], Policy]:
    """Makes the env of a policy's task on a backend; opens the policy."""
    register_envs()
    opened, task = open_policy(policy, model, conditions.kind)
    task = replace(task, **conditions.task)
    limit = conditions.steps or find_pace(model, [world]).steps
    options: dict[str, Any] = {
        "max_episode_steps": limit,
        "backend": backend,
        "model": model,
        "world": world,
        "task": task,
    }
    return gymnasium.make(NAVIGATION, **options), opened


def check_place(place: str, robot: RobotSpec) -> None:
    """Raises ConfigError if a place is unknown, lacks a module or can't simulate a robot."""
    if place not in PLACES:
        raise ConfigError(
            f"--in {place!r}: there is no such simulator; {suggest(place, PLACES)}"
        )
    if place == FAST:
        return
    robot.require_cmd_vel()
    extensions.require(f"the world {place!r}", "rclpy")
    if place != DDS:
        extensions.load("nodes", NODES[place])
        module = extensions.find_extensions("nodes")[NODES[place]].module
        import_module(module).check(robot)


def find_robot(policy: str, contract: Contract) -> str:
    """Returns the robot that a policy was trained for: its model's path, or a shipped robot."""
    place = str(contract.provenance.get("model", ""))
    name = contract.robot.name
    if place and Path(place).exists():
        return place
    if name in list_shipped("robots"):
        return name
    where = f"; its model was {place}, which is gone" if place else ""
    fix = "give its model with --model"
    raise ConfigError(
        f"{policy}: is for the robot {name!r}, which is not shipped{where}; {fix}."
    )


def read_contracts(
    policies: Sequence[str], model: str | None = None
) -> dict[str, Contract]:
    """Returns policy -> contract for all policy files; baselines have no contract."""
    files = [policy for policy in policies if is_policy_file(policy)]
    if not files:
        return {}
    # needs onnx; baselines don't
    from nics_drl_bridge.policy.file.policy_file import load_policy

    opened = None if model is None else open_model(model)
    return {policy: load_policy(policy, opened).contract for policy in files}


@dataclass(frozen=True)
class EvaluationOrder:
    """An order to evaluate policies; `seed` is the first episode's."""

    policies: Sequence[str]  # files, or names of shipped policies or baselines
    out: Path  # output folder
    # folder of a model, or a shipped robot; None: the robot of the policies
    model: str | None = None
    world: str = defaults.EVALUATION_WORLD  # name or YAML file
    episodes: int = defaults.EVALUATION_EPISODES
    seed: int = defaults.EVALUATION_SEED
    # some of `PLACES`, the first being the reference; empty: the usual ones that work
    places: Sequence[str] = ()
    conditions: Conditions = NO_CONDITIONS

    @property
    def seeds(self) -> range:
        """Seeds of the episodes. Raises ConfigError for an invalid seed."""
        seeds = range(self.seed, self.seed + self.episodes)
        check_seeds([seeds.start, seeds.stop - 1])
        return seeds


@dataclass(frozen=True)
class Evaluated:
    """Results of one policy: its episodes and statistics in each place."""

    policy: str
    runs: Mapping[str, Sequence[Episode]]
    tallies: Mapping[str, Tally]


def evaluate(order: EvaluationOrder, say: Say, tell: Tell) -> list[Evaluated]:
    """Drives all policies through the same episodes everywhere; writes results and pictures."""
    contracts = read_contracts(order.policies, order.model)
    model, name = order.conditions.model(model_name(order.model, contracts), order.out)
    world = load_worlds(order.world)
    limited = limit_time(order.conditions, contracts, model, world, say)
    places = select_places(order, model.robot, say)
    evaluated = []
    for policy in order.policies:
        runs = {}
        for place in places:
            what = f"{Path(policy).stem} {LABELS[place]}"
            say(f"driving {order.episodes} episodes of {policy} {LABELS[place]}")
            tell(what, 0, order.episodes)

            def on_episode(episode: Episode, what: str = what) -> None:
                tell(what, episode.seed - order.seed + 1, order.episodes)

            runs[place] = drive_in(
                place,
                policy,
                name,
                order.world,
                order.seeds,
                order.out / "logs",
                on_episode,
                say,
                limited,
            )
        evaluated.append(
            judge_runs(
                policy, runs, model, world, order.out, EPISODE_PANELS, order.policies
            )
        )
        write_evaluation(replace(order, conditions=limited), name, model, evaluated)
    return evaluated


def limit_time(
    conditions: Conditions,
    contracts: Mapping[str, Contract],
    model: SimulatorModel,
    world: AnyWorld,
    say: Say,
) -> Conditions:
    """Returns conditions with a time limit, and warns if it is short.

    It is that of the conditions, else the longest of the policies, else one for robot and world.
    """
    pace = find_pace(model, [world])
    limits = [
        contract.max_episode_steps
        for contract in contracts.values()
        if contract.max_episode_steps
    ]
    steps = conditions.steps or max(limits, default=pace.steps)
    short = pace.shortfall(steps)
    if short is not None:
        say(short)
    return replace(conditions, steps=steps)


def select_places(order: EvaluationOrder, robot: RobotSpec, say: Say) -> Sequence[str]:
    """Returns the places of an order, or the usual ones that work; reports why others don't."""
    places: list[str] = []
    for place in order.places or BY_DEFAULT:
        try:
            check_place(place, robot)
        except ConfigError as error:
            if order.places:
                raise
            usable = " and ".join(LABELS[place] for place in places)
            say(f"only {usable}: {error}")
            break
        places.append(place)
    return places


def judge_runs(
    policy: str,
    runs: Mapping[str, Sequence[Episode]],
    model: SimulatorModel,
    world: AnyWorld,
    out: Path,
    panels: int | None = None,
    among: Sequence[str] = (),
) -> Evaluated:
    """Computes a policy's statistics by place, and draws the first episodes into a folder."""
    shown = {LABELS[place]: episodes[:panels] for place, episodes in runs.items()}
    picture = draw_trajectories(shown, world, model.robot.footprint_radius)
    write_bytes(out / f"trajectories_{shorten_name(policy, among)}.png", picture)
    return Evaluated(policy, runs, evaluation.tallies(runs, model.control_period))


ENDS = r"\.(onnx|ya?ml)$"  # suffixes of a policy or a mapping


def shorten_name(policy: str, among: Sequence[str]) -> str:
    """Returns the stem of a policy's path, with parent folders if another has the same stem."""
    path, *others = (
        Path(re.sub(ENDS, "", file)).absolute().parts
        for file in (policy, *(other for other in among if other != policy))
    )
    for count in range(1, len(path)):
        if all(other[-count:] != path[-count:] for other in others):
            return "_".join(path[-count:])
    return path[-1]


def model_name(model: str | None, contracts: Mapping[str, Contract]) -> str:
    """Returns the model to drive: the given one, or that of the policy files; else the default."""
    if model is not None:
        return model
    robots = {
        policy: find_robot(policy, contract) for policy, contract in contracts.items()
    }
    if not robots:
        return DEFAULT_ROBOT
    if len(set(robots.values())) > 1:
        listed = ", ".join(
            f"{policy!r} is for {robot!r}" for policy, robot in robots.items()
        )
        fix = "evaluate them one by one, or choose a model with --model"
        raise ConfigError(f"the policies are for different robots: {listed}; {fix}.")
    return next(iter(robots.values()))


def write_evaluation(
    order: EvaluationOrder, name: str, model: SimulatorModel, evaluated: list[Evaluated]
) -> None:
    """Writes the `evaluation.json` of an order, driven with a model called `name`."""
    policies = {
        result.policy: {
            place: {
                **result.tallies[place].figures(),
                "each": [episode.plain() for episode in episodes],
            }
            for place, episodes in result.runs.items()
        }
        for result in evaluated
    }
    data = {
        "model": name,
        "model_fingerprint": model.fingerprint,
        "robot": model.robot.name,
        "world": order.world,
        "seed": order.seed,
        "conditions": asdict(order.conditions),
        "policies": policies,
    }
    write_text(order.out / EVALUATION, format_json(data) + "\n")


def format_rows(evaluated: Sequence[Evaluated]) -> list[tuple[str, ...]]:
    """Returns the rows of the table with the columns `HEADS`, as text."""
    return [
        (
            result.policy,
            LABELS[place],
            _format_percent(tally.success.value),
            f"{100 * tally.success.low:.0f} to {100 * tally.success.high:.0f} %",
            _format_percent(tally.believed.value),
            _format_percent(tally.collision.value),
            _format_percent(tally.time_out.value),
            _format_mean(tally.length.value),
            _format_mean(tally.time.value),
            _format_percent(tally.same),
            f"{tally.deviation.value:.2g}",
            f"{tally.greatest_deviation:.2g}",
        )
        for result in evaluated
        for place, tally in result.tallies.items()
    ]


def _format_percent(fraction: float) -> str:
    return f"{100 * fraction:.4g} %"


def _format_mean(value: float) -> str:
    """Formats a mean of the successful episodes, which is nan if there are none."""
    return "-" if isnan(value) else f"{value:.2f}"


def summarize(result: Evaluated) -> str:
    """Summarises a policy in one line."""
    labels = LABELS | {VEHICLE: f"{LABELS[VEHICLE]}, as believed,"}
    rates = [
        f"{labels[place]} {_format_percent(tally.success.value)}"
        for place, tally in result.tallies.items()
    ]
    return f"{result.policy}: success {', '.join(rates)}"


def _examine_vehicle(model: SimulatorModel, namespace: str, imu: str, say: Say) -> None:
    """Listens to a vehicle; raises BackendError if it does not fit its model."""
    from nics_drl_bridge.nodes.listen import listen

    say(f"listening to the vehicle for {defaults.LISTEN_S:g} s, as nics doctor does")
    errors = []
    heard = listen(defaults.LISTEN_S, namespace, imu=imu)
    for finding in examine(heard, derive_expected(model)):
        sentence = f"{finding.where}: {finding.what} ({finding.fix})"
        say(f"  {finding.severity}: {sentence}")
        if finding.severity == "error":
            errors.append(sentence)
    if errors:
        raise BackendError(
            f"the vehicle is not driven: {errors[0]}; see nics doctor for the rest."
        )


def _drive_again(
    episodes: Sequence[Episode],
    policy: str,
    model: SimulatorModel,
    world: str,
    conditions: Conditions,
) -> list[Episode]:
    """Drives a vehicle's episodes in the fast simulator, from their starts to their goals."""
    env, driver = open_env(policy, model, world, "sim", conditions, estimator=True)
    simulated = []
    with closing(env):
        for driven in episodes:
            reset_options = {"start": driven.path[0], "goal": driven.goal}
            simulated.append(drive(env, driver, driven.seed, reset_options))
    return simulated


@dataclass(frozen=True)
class VehicleDrive:
    """Drives episodes on the vehicle and in the fast simulator, and compares them.

    Commands go to `cmd_vel_raw`, and so through an armed gate. The fast simulator starts at the
    vehicle's actual starting poses.
    """

    order: EvaluationOrder
    goals: GoalOrder
    say: Say
    ask: Say  # gets each start, and returns when the episode may begin
    # gets each goal beyond a distance limit, and returns if the vehicle may drive there; None: such
    # a goal is refused
    confirm: Say | None = None
    arm: bool = False  # arm the gate before each episode

    def _draw_scenes(self, model: SimulatorModel, world: AnyWorld) -> list[Scene]:
        """Draws the episodes; refuses far goals before the operator has to wait."""
        radius = model.robot.footprint_radius
        scenes = [sample_scene(world, radius, seed) for seed in self.order.seeds]
        if not self.goals.needs_pose:
            planned = map(self.goals.episode, scenes)
            farthest = max(planned, key=lambda episode: episode.distance)
            farthest.confirm(self.confirm)
        return scenes

    def run(self, **options: Any) -> Evaluated:
        """Drives everything, and writes the results; `options` are those of the backend.

        Raises BackendError if the vehicle does not answer or does not fit its model, ConfigError if
        a goal is refused.
        """
        order = self.order
        policy = order.policies[0]
        contracts = read_contracts(order.policies, order.model)
        name = model_name(order.model, contracts)
        model = open_model(name)
        world = load_worlds(order.world)
        scenes = self._draw_scenes(model, world)
        conditions = limit_time(order.conditions, contracts, model, world, self.say)
        # A policy that does not fit must be refused before anything moves.
        open_policy(policy, model, conditions.kind)
        imu = options.get("imu", defaults.IMU_TOPIC)
        _examine_vehicle(model, options.get("namespace", ""), imu, self.say)
        driven = self._drive(model, world, scenes, conditions, options)
        runs = {VEHICLE: driven}
        try:
            runs[FAST] = _drive_again(driven, policy, model, order.world, conditions)
        except ConfigError as error:  # the start may be inside a wall of the map
            self.say(f"  not driven again in process: {error}")
        result = judge_runs(policy, runs, model, world, order.out)
        write_evaluation(replace(order, conditions=conditions), name, model, [result])
        return result

    def _drive(
        self,
        model: SimulatorModel,
        world: AnyWorld,
        scenes: Sequence[Scene],
        conditions: Conditions,
        options: dict[str, Any],
    ) -> list[Episode]:
        """Drives the vehicle; only its own estimate of its path is known."""
        goals = self.goals
        ground = goals.ground(world)
        fixed = {"mode": "realtime", "vehicle": True, "command_topic": RAW}
        fixed |= {"say": self.say, "start": goals.start, "lays_map": goals.lays_map}
        backend = make_backend("dds", model, ground, **fixed, **options)
        env, driver = make_env(
            backend, self.order.policies[0], model, ground, conditions
        )
        begin = partial(_arm, self.arm, options.get("namespace", ""), self.say)
        episodes = list[Episode]()
        with closing(env):
            for seed, scene in zip(self.order.seeds, scenes, strict=True):
                episode = self._agree_on_episode(
                    scene, backend.present_pose, len(episodes) + 1
                )
                driven = drive(env, driver, seed, episode.options, begin)
                episodes.append(replace(driven, path=driven.estimate))
                self.say(f"  {report_end(episodes[-1])}")
        return episodes

    def _agree_on_episode(
        self, scene: Scene, find_pose: Callable[[], Array], number: int
    ) -> VehicleEpisode:
        """Asks for the start of an episode, and for confirmation of a far goal; returns it."""
        goals = self.goals

        def ask(asked: VehicleEpisode) -> None:
            last = "" if self.arm else f"; arm {GATE}"
            which = f"episode {number} of {self.order.episodes}"
            self.ask(f"{which}: {asked.sentence()}{last}")

        if not goals.needs_pose:
            episode = goals.episode(scene)
            ask(episode)
            return episode
        asked = goals.episode(scene, find_pose())
        asked.confirm(self.confirm)
        ask(asked)
        episode = goals.episode(scene, find_pose())
        if episode.distance > asked.distance + NEAR_M:  # it was moved in the meantime
            episode.confirm(self.confirm)
        return episode


ENDS_BELIEVED = {"success": "reached", "collision": "touched"}


def report_end(episode: Episode) -> str:
    """Describes the end of an episode on a vehicle, by its own estimate: the truth is unknown."""
    end = ENDS_BELIEVED.get(episode.result, episode.result)
    end = f"{end}, as believed"
    if episode.uncertain is not None:
        end = f"{end}; {episode.uncertain.describe_since('the start')}"
    return f"{end}; {episode.steps} steps, {episode.length:.2f} m"


def _arm(wanted: bool, namespace: str, say: Say) -> None:
    if not wanted:
        return
    from nics_drl_bridge.nodes.operator import Operator

    with Operator() as operator:
        armed = operator.arm(namespace, ARM_S, False, say)
    if not armed.granted:
        raise BackendError(f"{armed.node} can't be armed: {armed.told}")
    say(f"  {armed.node} is armed")
