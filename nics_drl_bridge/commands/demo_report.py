"""The page of `nics demo`: verdict, paths in the world, the policy and the model."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from math import isfinite
from pathlib import Path

from nics_drl_bridge import defaults
from nics_drl_bridge.commands.episodes import DDS, FAST, LABELS
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.report import conclude
from nics_drl_bridge.policy.evaluation import Episode, Summary, deviation, successes
from nics_drl_bridge.report import html, pictures
from nics_drl_bridge.report.fit_page import (
    fit_tile,
    make_path_blocks,
    make_verdict_blocks,
    model_blocks,
)
from nics_drl_bridge.sim.world import load_world

AS_IT_IS = "as it is"
PERTURBED = "mild"
GOOD = 0.9  # success rate below which the verdict is doubtful
DEMO_PANELS = 9  # maximum number of drawn episodes


@dataclass(frozen=True)
class DemoPlan:
    """What a demo uses, and where it writes."""

    out: Path  # output folder
    # name or YAML file, as for the world; None: taken from the recording
    robot: str | None = None
    world: str = defaults.WORLD
    # file of a drive; None: record one with the robot's textbook kinematics
    recording: Path | None = None
    episodes: int = defaults.DEMO_EPISODES  # in process, and as many over DDS
    # policy file or name to use instead of training one
    policy: str | None = None
    # environment steps of the training; None: from `demo.yaml`
    train_steps: int | None = None

    @property
    def model(self) -> Path:
        """Folder of the generated simulator."""
        return self.out / "model"


@dataclass(frozen=True)
class Learned:
    """The demo's policy (file or name), its origin as a sentence, and its training curve."""

    policy: str
    how: str
    curve: Sequence[pictures.Point] = ()


@dataclass(frozen=True)
class DemoResults:
    """Results of all parts of a demo. Without ROS 2, `there` is empty and `live` is None."""

    plan: DemoPlan
    model: SimulatorModel
    identified: Identified
    learned: Learned
    summaries: Mapping[str, Summary]  # by condition: `AS_IT_IS` and each perturbation
    here: Sequence[Episode]  # in process
    there: Sequence[Episode]  # the same over DDS
    live: Episode | None  # the deployed episode

    @property
    def arrived(self) -> bool:
        """True if the deployed episode reached its goal."""
        return self.live is not None and self.live.result == "success"

    def draw_trajectories(
        self, episodes: Mapping[str, Sequence[Episode | None]]
    ) -> bytes:
        """Draws the first episodes of each place as a PNG."""
        shown = {place: drives[:DEMO_PANELS] for place, drives in episodes.items()}
        world = load_world(self.plan.world)
        radius = self.model.robot.footprint_radius
        return pictures.draw_trajectories(shown, world, radius)


def make_sections(results: DemoResults) -> list[tuple[str, Sequence[str]]]:
    """Returns the sections of the report, verdict first: a heading and HTML blocks each."""
    model = results.model
    identified = results.identified
    return [
        ("Verdict", make_verdict(results)),
        ("Paths in the world", format_episodes(results)),
        ("The policy", _make_policy_lines(results)),
        ("Paths of the model", make_path_blocks(identified)),
        ("The model", model_blocks(model.robot, identified, model.report)),
    ]


def make_verdict(results: DemoResults) -> Sequence[str]:
    """Returns the fit, the success in three worlds, and the next step."""
    summary = results.summaries[AS_IT_IS]
    success = summary.success
    between = f"95 % confidence: {100 * success.low:.1f} to {100 * success.high:.1f} %"
    tiles = [
        fit_tile(results.identified),
        (
            f"{100 * success.value:.1f} %",
            f"of {summary.episodes} unseen episodes succeed in the fast simulator ({between})",
            success.value >= GOOD,
        ),
    ]
    if results.live is not None:
        count = len(results.there)
        reached = successes(results.there)
        told = f"in process, {successes(results.here)} of the same {count}"
        told = f"episodes succeed over DDS; {told}"
        tiles.append((f"{reached} of {count}", told, reached >= GOOD * count))
        end = "arrived" if results.arrived else "did not arrive"
        tiles.append((end, "deployed, in real time", results.arrived))
    conclusion = conclude(results.identified)
    if conclusion.ready:
        next_step = "train longer, with --train-steps"
        if success.value >= GOOD:
            next_step = "drive more episodes, or use a recording of your own robot"
        conclusion = conclusion._replace(advice=f"Next: {next_step}.")
    plan = results.plan
    driven = f"{results.learned.policy} --model {plan.model} --world {plan.world}"
    return make_verdict_blocks(
        tiles,
        conclusion,
        f"nics watch {driven}",
        f"nics evaluate {driven}",
        "nics demo --recording DRIVE --robot ROBOT.yaml  # your own robot",
    )


def _make_policy_lines(results: DemoResults) -> list[str]:
    learned = results.learned
    blocks = [html.make_paragraph(learned.how)]
    if learned.curve:
        caption = "Success and collisions during exploration; every episode is new."
        curve = pictures.draw_training_curve(learned.curve)
        blocks.append(html.make_picture(curve, caption))
    text = (
        f"{results.summaries[AS_IT_IS].episodes} unseen episodes in the world "
        f"{results.plan.world!r}, in parallel in the fast simulator, without exploration; path and "
        f"time are means of the successful ones. Below, each perturbation of {PERTURBED!r} alone."
    )
    return [
        *blocks,
        html.make_paragraph(text),
        html.make_table(("", "value", "95 % from", "to"), _list_figures(results)),
    ]


def _list_figures(results: DemoResults) -> list[tuple[str, ...]]:
    """Returns a row for each result of the evaluation: its name, value, and 95 % bounds."""
    summary = results.summaries[AS_IT_IS]
    fractions = dict(summary.shares)
    for what, perturbed in results.summaries.items():
        if what != AS_IT_IS:
            fractions[f"success with {what.replace('_', ' ')}"] = perturbed.success
    rows = list[tuple[str, ...]]()
    for name, fraction in fractions.items():
        rows.append((name, *(f"{100 * value:.1f} %" for value in astuple(fraction))))
    for name, amount in (("path [m]", summary.length), ("time [s]", summary.time)):
        texts = (
            f"{value:.2f}" if isfinite(value) else "-" for value in astuple(amount)
        )
        rows.append((name, *texts))
    return rows


def format_episodes(results: DemoResults) -> list[str]:
    """Returns how the episodes ended, their paths, and a table."""
    here = results.here
    there = results.there
    live = results.live
    reached = f"{successes(here)} of {len(here)} episodes reached the goal in process"
    if live is None:
        png = results.draw_trajectories({LABELS[FAST]: here})
        return [html.make_paragraph(f"{reached}."), html.make_picture(png, "")]
    shown = {
        LABELS[FAST]: here,
        LABELS[DDS]: there,
        "deployed": [live if episode.seed == live.seed else None for episode in here],
    }
    text = (
        f"{reached}, {successes(there)} of {len(there)} over DDS in lock-step. Then simulator_node "
        "in real time, middleware_node, policy_node and command_gate ran as separate processes, "
        f"not in lock-step. The robot {'reached' if results.arrived else 'did not reach'} "
        f"its goal, that of seed {live.seed}."
    )
    about = "Deviation is the greatest distance between the two true paths at the same step."
    rows = [
        (f"{a.seed}", *_describe(a), *_describe(b), f"{deviation(a, b):.1g}")
        for a, b in zip(here, there, strict=True)
    ]
    columns = ("steps", "path [m]")
    heads = ("seed", LABELS[FAST], *columns, LABELS[DDS], *columns, "deviation [m]")
    table = html.make_table(heads, rows)
    return [
        html.make_paragraph(text),
        html.make_picture(results.draw_trajectories(shown), ""),
        html.make_details("Episode by episode", [html.make_paragraph(about), table]),
    ]


def _describe(episode: Episode) -> tuple[str, ...]:
    return episode.result, f"{episode.steps}", f"{episode.length:.2f}"
