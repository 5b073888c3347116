"""Train a policy briefly in the fast simulator; the result is one file, `policy.onnx`."""

from pathlib import Path

from nics_drl_bridge.policy.train import run as train
from nics_drl_bridge.policy.train.progress import Progress
from nics_drl_bridge.policy.train.settings import chosen_settings
from nics_drl_bridge.report.pictures import Point, draw_training_curve

STEPS = 120_000  # half a minute; `nics demo` takes 400,000
OUT = Path("runs/example")


def main() -> None:
    changes = {"steps": STEPS, "worlds": {"arena": 128}}
    # config/training/demo.yaml
    settings = chosen_settings("navigation", "demo", changes)
    curve = []

    def tell(progress: Progress) -> None:
        curve.append(Point(progress.steps, progress.success, progress.collision))

    result = train.run(
        train.TrainOrder(settings, seeds=[0], out=OUT, episodes=100), tell
    )[0]
    print(f"{result.trained.steps} steps: {train.line_of(result.summaries['arena'])}")
    print(f"the policy is {OUT}/seed_0/policy.onnx")
    Path("train_policy.png").write_bytes(draw_training_curve(curve))


if __name__ == "__main__":
    main()
