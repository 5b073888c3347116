"""The campaigns: long proofs of promises, each with a short form and controls that must fail.

`python test/campaigns/NAME.py` runs a campaign, `--short` its short form. Under a control, what the
campaign proves is taken out, so that it has to miss the bar that is named here.
`make test-campaign` runs all short forms and all controls.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
NAV2_SOURCES = ROOT.parent / "shared" / "upstream" / "nav2_interfaces.tar.gz"
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "test")]

from bench import (  # noqa: E402
    Bar,
    Bars,
    Benchmark,
    Control,
    Given,
    Result,
    Silence,
    at_least,
    at_most,
    find_missed,
    some_of,
)

__all__ = [
    "CAMPAIGNS",
    "FOLDER",
    "NAV2_SOURCES",
    "ROOT",
    "Bar",
    "Bars",
    "Given",
    "Result",
    "Silence",
    "at_least",
    "at_most",
    "find_missed",
    "run_campaign",
    "some_of",
    "tell",
]


@dataclass(frozen=True)
class Campaign:
    """One campaign.

    Attributes:
        short: arguments of the short form.
        controls: by their names.
        needs: modules to import; `root` for root with `ip` and `nft`, `nav2` for Nav2's sources.
        script: where it is not the campaign's name.
        quick: whether `make test` runs the short form, too.
        attempts: of a short form that a busy machine may hold up.
        timeout_s: of one attempt.
    """

    short: str
    controls: Mapping[str, Control] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    script: str = ""
    quick: bool = False
    attempts: int = 1
    timeout_s: float = 600.0


REAL_TIME = 3
ROS = ("rclpy",)
FILES = ("torch", "rosbags")
MESSAGES = ("rclpy", "simulation_interfaces")
ONE_RULE = "--tests test/gate/test_arming.py --rule arming/one_publisher"
ONE_FAULT = "--repeats 1 --fault scan_silent"
ENV = "--steps 30000 --cases arena"
FAULTS = (
    "scan_silent",
    "e_stop",
    "policy_hung",
    "odom_teleports",
    "stamps_run_ahead",
    "scan_alternates",
    "gate_frozen",
    "no_motion",
)
CAMPAIGNS: dict[str, Campaign] = {
    "abuse_env": Campaign(
        "--rounds 3 --seed 1",
        {
            "no_guard": Control(
                "what stops the robot when an exception leaves the env",
                "moved",
                "--rounds 2",
            )
        },
        ROS,
    ),
    "barn_in_dart": Campaign(
        "--every 50 --poses 4",
        {
            "moved": Control(
                "the place: this package's worlds are moved by 5 cm",
                "beams within 1 cm",
            )
        },
        ("dartpy",),
    ),
    "damaged_input": Campaign(
        "--rounds 40 --seed 5",
        {
            "credulous": Control(
                "the checks of policies and of YAML",
                "must be at most 0",
                "--rounds 120 --seed 1",
            ),
            "no_checksum": Control(
                "the checksums of recordings, models, tables, policies and checkpoints",
                "accepted ",
                "--rounds 60 --seed 2",
            ),
        },
        FILES,
    ),
    "fast_robots": Campaign(
        "--steps 5 --robots 2000",
        {
            "fat": Control(
                "the touch: the robots are measured 2 mm larger", "overlap_mm"
            ),
            "no_walls": Control(
                "the walls between the rooms, for the simulator", "passed_a_wall"
            ),
        },
        quick=True,
    ),
    "gate_envelope": Campaign(
        "--steps 1200",
        {
            "no_limits": Control(
                "the gate's limits: they are a hundred times as wide",
                "violations ",
            ),
            "standing": Control("the commands: all are zero", "share_in_motion 0"),
        },
        quick=True,
    ),
    "gate_faults": Campaign(
        "--repeats 2 " + " ".join(f"--fault {name}" for name in FAULTS),
        {
            "slow_gate": Control(
                "the gate's ages: it lets data get ten times as old",
                "scan_silent: time to zero [s]",
                ONE_FAULT,
            ),
            "no_gate": Control(
                "the gate: commands are relayed past it",
                "scan_silent: time to zero [s] inf",
                ONE_FAULT,
            ),
            "standing": Control(
                "the motion: the robot is never told to move",
                "scan_silent: injections while the robot moved 0",
                ONE_FAULT,
            ),
        },
        ROS,
        attempts=REAL_TIME,
    ),
    "gate_held": Campaign(
        "--hours 0.02 --holds 8 --case 7",
        {
            "rule_off": Control(
                "the rule: `stop_when_held` is false",
                "held bodies that were stopped in time",
                "--hours 0.01 --holds 4 --case 7",
            ),
            "zero_thresholds": Control(
                "the rule's thresholds: any scan contradicts odometry",
                "stops by body_held",
                "--hours 0.01 --holds 4 --case 7",
            ),
        },
        quick=True,
    ),
    "gate_load": Campaign(
        "--seconds 4",
        {
            "busy": Control(
                "haste: the gate decides ten times on each message",
                "the gate's share of a core",
            ),
        },
        ROS,
        attempts=REAL_TIME,
    ),
    "gate_rules": Campaign(
        ONE_RULE,
        {
            "no_tests": Control(
                "the tests of the gate's rules", "rule arming/one_publisher"
            ),
            "untested_rule": Control(
                "the test of a rule: one is added that no test covers",
                "rule stop/covers_nothing",
            ),
        },
    ),
    "generated": Campaign(
        "--engines dart --robots differential --train 40 --unseen 15",
        {
            "standing": Control(
                "what was learnt: the model stands still", "error over the path"
            )
        },
        ("mujoco", "dartpy"),
    ),
    "node_endings": Campaign(
        "--times 2 --loops 0 --nodes middleware_node --phases starting compiling native",
        {
            "late": Control(
                "the handler that ends a node within a step of native code",
                "middleware_node native: took [s]",
                "--times 2 --loops 0 --nodes middleware_node --phases native",
            )
        },
        ROS,
        attempts=REAL_TIME,
    ),
    "packet_loss": Campaign(
        "--seconds 8 --loss 20",
        {
            "no_gate": Control(
                "the gate: the policy's last command is repeated to the base",
                "unsafe_commands",
                "--seconds 6 --loss 40",
            ),
            "standing": Control(
                "the motion: nobody arms the gate", "invalid: nothing moved"
            ),
            "no_loss": Control("the losses", "none was lost"),
            "slow_robot": Control("two scans of three", "scans that the robot sent"),
        },
        ("rclpy", "root"),
        attempts=REAL_TIME,
    ),
    "parity": Campaign(
        "--steps 25 --robot ackermann",
        {
            "noise": Control("the last bit of one number", "difference "),
            "late": Control(
                "one observation, of which the one before is told again",
                "late_observations",
            ),
            "standing": Control("the commands: no robot drives", "driven_m 0:"),
        },
        ROS,
    ),
    "parity_fleet": Campaign(
        "--steps 25 --robot ackermann --robots 2 --seed 5", {}, ROS, "parity"
    ),
    "ros_fleet": Campaign(
        "--robots 2 --seconds 2",
        {
            "standing": Control("the commands: no robot drives", ": driven_m 0"),
            "deaf": Control(
                "the topics of one robot, which nobody receives",
                "robot2: scan 0:",
                "--robots 2 --seconds 2 --patience 15",
            ),
        },
        ROS,
        attempts=REAL_TIME,
    ),
    "shield": Campaign(
        "--episodes 18",
        {
            "no_shield": Control("the shield: it is off", "contacts of"),
            "standing": Control(
                "the motion: every driver stays where it is", "path driven"
            ),
            "no_braking_distance": Control(
                "what the robot needs to stop: the shield is told that it needs nothing",
                "braking distance",
            ),
        },
    ),
    "soak": Campaign(
        "--minutes 0.2 --warm-up 0.1",
        {
            "standing": Control(
                "the gate's consent: the robot in real time never moves",
                "driven_m 0:",
                "--minutes 0.05 --warm-up 0.0",
            ),
            "leak": Control(
                "order: each episode leaves a file open",
                "growth: files: env ",
                "--minutes 0.2 --warm-up 0.0",
            ),
        },
        ROS,
        attempts=REAL_TIME,
    ),
    "soak_env": Campaign(
        "--steps 40000 --cases arena team",
        {
            "stuck": Control(
                "motion: the poses of one world are put back after each step",
                "a robot that stood for",
                ENV,
            ),
            "blind": Control(
                "news: one world goes on telling its first observation",
                "an observation that stood for",
                ENV,
            ),
            "endless": Control(
                "the env's time limit", "an episode of", f"{ENV} --limit 10"
            ),
            "leak": Control(
                "thrift: 1 MB and a file more are held after each round",
                "file descriptors more",
                ENV,
            ),
        },
        quick=True,
    ),
    "standards": Campaign(
        "--parts conformance",
        {
            "claims": Control(
                "conformance: a feature that is not there counts as announced",
                "is announced, but",
            ),
            "idle": Control(
                "conformance: nothing is done, and all is answered as done",
                "SPAWNING is announced, but does not do",
            ),
        },
        MESSAGES,
        timeout_s=900.0,
    ),
    "nav2_standards": Campaign(
        "--parts nav2 --episodes 3",
        {
            "bare": Control(
                "a known controller, and all nodes but the simulator",
                "follow_path_success",
                "--parts nav2 --episodes 1",
            )
        },
        ("rclpy", "nav2_msgs", "nav2"),
        "standards",
        timeout_s=900.0,
    ),
    "torn_files": Campaign(
        "--kills 8",
        {
            "naive_writer": Control(
                "the temporary file: what is written is written where it is to lie",
                "torn ",
                "--kills 12",
            )
        },
        FILES,
    ),
    "transfer": Campaign(
        "--episodes 2 --robots differential --engines fast,mujoco,dart",
        {
            "standing": Control(
                "the driving: the policy stands still", "success in the fast simulator"
            ),
            "ice": Control(
                "the grip of the tyres: the floor of the engines is ice",
                "points of success apart",
                "--episodes 3 --robots differential --engines fast,dart",
            ),
        },
        ("mujoco", "dartpy"),
        timeout_s=1200.0,
    ),
    "unknown_robot": Campaign(
        "--goals 10",
        {
            "no_gyro": Control(
                "the gyro, so that the estimator believes slipping wheels", "success"
            ),
            "no_gate_rule": Control(
                "the rule that compares scans with odometry, so that a held body goes on",
                "a held body was stopped",
            ),
        },
        ("rclpy", "dartpy"),
        timeout_s=3500.0,
    ),
}


def tell(line: str) -> None:
    """Tells of progress, beside the answer."""
    sys.stderr.write(f"{line}\n")


def run_campaign(
    measure: Callable[[Given], Result],
    bars: Bars | Callable[[Result], Bars],
    options: Mapping[str, Any] | None = None,
) -> NoReturn:
    """Runs the campaign whose script is running, as a benchmark with its controls and short form.

    See `bench.Benchmark` for the arguments.
    """
    script = Path(sys.argv[0]).stem
    own = [each for name, each in CAMPAIGNS.items() if (each.script or name) == script]
    controls = {name: taken for each in own for name, taken in each.controls.items()}
    campaign = Benchmark(measure, bars, controls, options or {}, own[0].short)
    campaign.run(sys.argv[1:], sys.modules["__main__"].__doc__)
