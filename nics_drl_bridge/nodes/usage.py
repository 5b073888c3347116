"""Help texts of the nodes and a check of their arguments, without ROS 2."""

import textwrap
from collections.abc import Sequence
from typing import Any

from nics_drl_bridge.nodes.parameters import NODES, Row

HELP = ("-h", "--help")
ROS = "--ros-args"
END = "--"
WIDTH = 100
INDENT = 4


def help_of(node: str) -> str:
    """Return the help of a node by the name of its executable."""
    if node not in NODES:
        return f"usage: {node} [{ROS} -p NAME:=VALUE -r FROM:=TO ...]\n"
    facts = NODES[node]()
    topics = [
        _hanging(f"{title}: {', '.join(names)}", INDENT)
        for title, names in (
            ("subscribes to", facts.subscribes),
            ("publishes", facts.publishes),
            ("services", facts.services),
        )
        if names
    ]
    parts = [
        f"usage: {node} [{ROS} -p NAME:=VALUE -r FROM:=TO --params-file FILE ...]",
        facts.about,
        "\n".join(topics),
        "parameters, with their defaults:",
        "\n".join(map(_line, facts.parameters)),
        "and `use_sim_time`, like every ROS 2 node. `ros2 param describe` also shows the ranges.",
        f"example:\n    ros2 run nics_drl_bridge {node} {ROS} {facts.example}",
    ]
    return "\n\n".join(parts) + "\n"


def _line(row: Row) -> str:
    return _hanging(
        f"    {row.name} = {row.shown or _words(row.default)}: {row.about}", 2 * INDENT
    )


def _words(value: Any) -> str:
    """Return a value as it is written after `:=`."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_words, value))}]"
    text = str(value) if value != "" else "''"
    return f".{text}" if text == "nan" else text


def _hanging(text: str, indent: int) -> str:
    return textwrap.fill(text, WIDTH, subsequent_indent=" " * indent)


def wrong_with(node: str, words: Sequence[str]) -> str:
    """Return a sentence about the first word that is not an argument of a node, or ""."""
    ours = True  # False for the words that ROS 2 itself checks
    for word in words:
        if word in (ROS, END):
            ours = word == END
        elif ours:
            example = f"-p {word}" if ":=" in word else "-p NAME:=VALUE"
            fix = f"write parameters and remappings after {ROS}, as in `{node} {ROS} {example}`"
            return (
                f"{node}: there is no argument {word!r}; {fix}, or see `{node} --help`."
            )
    return ""
