"""The same episodes on the vehicle: in real time, through the command gate."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from nics_drl_bridge.commands import episodes as evaluation
from nics_drl_bridge.commands.episodes import FAST, VEHICLE, Evaluated, Say, env_of
from nics_drl_bridge.errors import BackendError
from nics_drl_bridge.generator import SimulatorModel, open_model
from nics_drl_bridge.policy.evaluation import Episode, drive
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.report.doctor import examine
from nics_drl_bridge.report.doctor_facts import expected_of
from nics_drl_bridge.sim.scenes import Scene, sample_scene
from nics_drl_bridge.sim.world import load_world

GATE, RAW = "command_gate", "cmd_vel_raw"
LISTEN_S, ARM_S = 5.0, 60.0


@dataclass(frozen=True)
class VehicleOrder:
    """An order to drive episodes on the vehicle; see `EvaluationOrder` for the first ones."""

    policy: str
    out: Path
    model: str | None = None
    world: str = "circles"
    episodes: int = 1
    seed: int = 0
    start: str = "wait"  # until the vehicle stands at the start; or `present`: from where it stands
    goal: tuple[float, float] | None = None  # in `map` [m] instead of the world's
    namespace: str = ""  # of its topics
    pose_type: str = "none"  # type of `pose`, a pose sensor in `map`, or `none`
    arm: bool = False  # True arms the gate before each episode; otherwise the user does
    stale_after_s: float = 0.5  # an episode ends with an error if data are older [s]


def drive_vehicle(order: VehicleOrder, say: Say, ask: Say) -> Evaluated:
    """Checks that the vehicle fits its model, drives the episodes, and compares them.

    Commands go to `cmd_vel_raw`, so that only an armed `command_gate` lets them pass. Afterwards
    the fast simulator drives the same episodes from the vehicle's actual starting poses. `ask` is
    called before each episode with where to place the vehicle, and returns when it may begin.
    Returns the episodes of both; `evaluation.json` and a picture are in `order.out`. Raises
    BackendError if the vehicle does not fit its model, or does not answer, another BridgeError for
    a bad name or file.
    """
    name = order.model or evaluation.robot_of(order.policy)
    model, world = open_model(name), load_world(order.world)
    open_policy(order.policy, model)  # a misfit is an error before anything moves
    _examine(order, model, say)
    episodes = _drive(order, model, say, ask)
    env, policy = env_of(order.policy, model, order.world, "sim", estimator=True)
    with closing(env):
        again = [
            drive(env, policy, one.seed, {"start": one.path[0], "goal": one.goal})
            for one in episodes
        ]
    runs = {VEHICLE: episodes, FAST: again}
    made = evaluation.judged(order.policy, runs, model, world, order.out)
    evaluation.write_evaluation(order.out, name, model, order.world, order.seed, [made])
    return made


def _examine(order: VehicleOrder, model: SimulatorModel, say: Say) -> None:
    """Runs the checks of `nics doctor`. Raises BackendError if they find an error."""
    from nics_drl_bridge.nodes.listen import listen

    say(f"listening to the vehicle for {LISTEN_S:g} s, as nics doctor does")
    errors = []
    for finding in examine(listen(LISTEN_S, order.namespace), expected_of(model)):
        sentence = f"{finding.where}: {finding.what} ({finding.fix})"
        say(f"  {finding.severity}: {sentence}")
        errors += [sentence] if finding.severity == "error" else []
    if errors:
        raise BackendError(f"the vehicle is not driven: {errors[0]}; see nics doctor for the rest.")


def _drive(order: VehicleOrder, model: SimulatorModel, say: Say, ask: Say) -> list[Episode]:
    options = {
        "mode": "realtime", "vehicle": True, "command_topic": RAW, "start": order.start,
        "namespace": order.namespace, "pose_type": order.pose_type, "say": say,
        "stale_after_s": order.stale_after_s,
    }  # fmt: skip
    env, policy = env_of(order.policy, model, order.world, "dds", backend_options=options)
    world, episodes = load_world(order.world), list[Episode]()
    goal = {} if order.goal is None else {"goal": order.goal}
    with closing(env):
        for count in range(order.episodes):
            seed = order.seed + count
            scene = sample_scene(world, model.robot.footprint_radius, seed)
            ask(f"episode {count + 1} of {order.episodes}: {_placed(order, scene)}")
            driven = drive(env, policy, seed, goal, lambda: _arm(order, say))
            # The vehicle's own estimate is all that is known of its path.
            episodes.append(replace(driven, path=driven.estimate))
            say(f"  {driven.result}, {driven.steps} steps, {episodes[-1].length:.2f} m")
    return episodes


def _placed(order: VehicleOrder, scene: Scene) -> str:
    """Instruction before an episode: where to place the vehicle, and where it will drive."""
    x, y = scene.goals[0] if order.goal is None else order.goal
    where = f"it will drive to ({x:.2f} m, {y:.2f} m)"
    armed = "" if order.arm else f"; arm {GATE}"
    if order.start == "present":
        return f"{where} from where it stands{armed}"
    sx, sy, heading = scene.starts[0]
    return f"place the vehicle at ({sx:.2f} m, {sy:.2f} m, {heading:.2f} rad); {where}{armed}"


def _arm(order: VehicleOrder, say: Say) -> None:
    if not order.arm:
        return
    from nics_drl_bridge.nodes.processes import Witness

    gate = f"{order.namespace}/{GATE}" if order.namespace else GATE
    with Witness() as witness:
        refused = witness.arms(gate, ARM_S)
    if refused:
        raise BackendError(f"{gate} can't be armed: {refused}")
    say(f"  {gate} is armed")
