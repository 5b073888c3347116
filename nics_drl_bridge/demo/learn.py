"""The demo's policy: trained in the generated simulator, or one that is there already."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from nics_drl_bridge.demo.plan import Plan, Say
from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.policy.policies import open_policy, shipped_policies
from nics_drl_bridge.policy.training_settings import TrainingSettings, load_training
from nics_drl_bridge.report.training_picture import Point

SETTINGS, SEED = "demo", 0
NEEDED = ("torch", "stable_baselines3", "tensorboard", "onnx", "onnxruntime")
BASELINE = "go_to_goal"
LINES = 10
"""How often a training tells how it gets on."""


@dataclass(frozen=True)
class Learned:
    """The policy that the demo drives with.

    Attributes:
        policy: a policy file or a name, see `policies.open_policy`.
        how: it came about, in a sentence.
        curve: of the training; empty where there was none.
    """

    policy: str
    how: str
    curve: Sequence[Point] = ()


def learn(plan: Plan, model: SimulatorModel, say: Say) -> Learned:
    """Trains a policy, unless the plan names one or what a training needs is not installed.

    Args:
        plan: what to do; the training writes into its folder.
        model: the generated simulator, which is in `plan.model` too.
        say: takes each line of progress.

    Raises:
        BridgeError: the named policy can't be used, or settings do not fit.
    """
    if plan.policy is not None:
        open_policy(plan.policy, model)
        return Learned(plan.policy, f"The policy {plan.policy!r} was given; none was trained.")
    missing = next((module for module in NEEDED if find_spec(module) is None), None)
    if missing is None:
        return _trained(plan, say)
    policy = _ready_made(model)
    say(
        f"not training, which needs the module {missing!r} (pip install "
        f"'nics_drl_bridge[train,deploy]'); driving with the policy {policy!r} instead"
    )
    return Learned(policy, f"None was trained, as {missing!r} is not installed: {policy!r} drives.")


def settings_of(plan: Plan) -> TrainingSettings:
    """The demo's training, in the plan's simulator and world."""
    chosen = load_training(SETTINGS)
    changes = {
        "robot": str(plan.model),
        "worlds": {plan.world: chosen.num_envs},
        "steps": plan.train_steps or chosen.steps,
    }
    return chosen.model_copy(update=changes)


def _trained(plan: Plan, say: Say) -> Learned:
    from nics_drl_bridge.policy.train import train  # needs torch
    from nics_drl_bridge.policy.train_progress import Progress
    from nics_drl_bridge.policy.train_run import SeedResult, export

    settings, curve = settings_of(plan), list[Point]()
    say(f"training a policy for {settings.steps:,} steps in {settings.num_envs} worlds at once")

    def tell(progress: Progress) -> None:
        before = curve[-1].steps if curve else 0
        curve.append(Point(progress.steps, progress.success, progress.collision))
        if progress.steps * LINES // settings.steps > before * LINES // settings.steps:
            say(
                f"  {progress.steps:,} steps: success {100 * progress.success:.1f} %, "
                f"{progress.steps_per_s:,.0f} steps/s"
            )

    trained = train(settings, SEED, plan.out / "training", tell)
    result = SeedResult(SEED, trained, {})
    export(settings, result, f"nics demo --robot {plan.robot}", plan.policy_file)
    steps = f"{trained.steps:,} steps, {trained.stepping_s:.0f} s of {trained.wall_s:.0f} s"
    how = f"PPO learned it from nothing in the generated simulator: {steps} in the simulator."
    return Learned(str(plan.policy_file), how, curve)


def _ready_made(model: SimulatorModel) -> str:
    """The shipped policy of the robot, where it fits, or a baseline."""
    name = model.robot.name
    if name in shipped_policies() and find_spec("onnxruntime") and find_spec("onnx"):
        try:
            open_policy(name, model)
        except PolicyError:
            return BASELINE
        return name
    return BASELINE
