"""The help of each command: its options, as its docstring describes them, and examples."""

import re
from typing import Any

import typer
from typer.core import TyperCommand

from nics_drl_bridge.commands.console import check_options

EXAMPLES = {
    "list": ("nics list robots", "nics list worlds --json"),
    "drive": ("nics drive --robot my_robot.yaml --out my_robot",),
    "generate": (
        "nics generate drive.npz --robot ackermann --out my_robot",
        "nics generate drive.csv --map drive.yaml --out my_robot",
    ),
    "inspect": ("nics inspect drive.csv --map drive.yaml",),
    "import": ("nics import drive.csv --map drive.yaml --out drive.npz",),
    "record": (
        "nics record --robot my_robot.yaml --out drive.npz --preview",
        "nics record --robot my_robot.yaml --out drive.npz --bound 2 --speed 0.3",
    ),
    "explain": ("nics explain ~/.ros/black_box/stop.jsonl",),
    "doctor": (
        "nics doctor --install",
        "nics doctor drive_bag --model my_robot",
        "nics doctor --policy policy.onnx --namespace robot1",
    ),
    "urdf": ("nics urdf my_robot --out my_robot.urdf",),
    "train": (
        "nics train --robot differential --world circles --out runs/first",
        "nics train --robot my_robot.yaml --world doorway --out runs/mine",
    ),
    "evaluate": (
        "nics evaluate differential dynamic_window --world circles --in fast",
        "nics evaluate runs/mine/seed_0/policy.onnx --world doorway --episodes 100",
    ),
    "assure": (
        "nics assure differential --limits differential --episodes 300",
        "nics assure my.onnx --limits my_limits.yaml --out runs/evidence",
    ),
    "watch": (
        "nics watch differential --world circles",
        "nics watch --bag drive",
        "nics watch jackal --world clutter --record episode.gif",
    ),
    "demo": ("nics demo", "nics demo --recording drive.npz --robot my_robot.yaml"),
    "warmup": ("nics warmup",),
    "up": (
        "nics up simulation world:=corridor",
        "nics up fleet robots:='[ant, bee]'",
        "nics up vehicle model:=my_car params_file:=car.yaml",
    ),
    "install": ("nics install tf2_msgs", "nics install tf2_msgs --prefix messages"),
    "arm": ("nics arm", "nics arm --reset --namespace ant"),
    "stop": ("nics stop", "nics stop --namespace ant"),
    "goal": ("nics goal 1 0", "nics goal 2 -0.5 --frame base_link --namespace ant"),
    "policy info": ("nics policy info differential --json",),
    "policy export": ("nics policy export policy.onnx --leapp bundle",),
    "policy import": ("nics policy import bundle --robot my_robot --out policy.onnx",),
    "world import": ("nics world import house.world --out house.yaml",),
    "world map": ("nics world map room --out room_map.yaml",),
    "world draw": ("nics world draw clutter --seed 3",),
    "bag record": ("nics bag record drive --duration 60",),
    "bag info": ("nics bag info drive --json",),
    "bag replay": ("nics bag replay drive --rate 2",),
    "bag export": ("nics bag export drive --mcap shown --model my_robot",),
}


class DocumentedCommand(TyperCommand):
    """Takes the help of its options from the section `Args` of its docstring."""

    def __init__(self, *words: Any, help: str, params: list[Any], **options: Any):
        text, _, section = help.partition("\n\nArgs:\n")
        lines = re.findall(r"^    (\w+): (.+(?:\n {5,}.+)*)", section, re.MULTILINE)
        about = {name: " ".join(line.split()) for name, line in lines}
        for param in params:
            param.help = param.help or about.get(param.name)
        super().__init__(*words, help=text, params=params, **options)


def complete(app: typer.Typer, group: str = "") -> None:
    """Adds `check_options`, and what its help needs, to each command of an app and its groups."""
    for command in app.registered_commands:
        command.cls = DocumentedCommand
        command.callback = check_options(command.callback) if command.callback else None
        name = command.name or str(getattr(command.callback, "__name__", ""))
        examples = EXAMPLES.get(f"{group}{name}")
        if examples:
            # click does not rewrap a paragraph whose first line is just this character.
            command.epilog = "\b\nExamples:\n" + "\n".join(
                f"  {line}" for line in examples
            )
    for subcommand in app.registered_groups:
        if subcommand.typer_instance is not None:
            complete(subcommand.typer_instance, f"{subcommand.name} ")
