"""`nics arm`, `nics stop` and `nics goal`: operate a robot without ROS 2's command line."""

from functools import partial
from typing import Annotated

import typer
from typer import Option

from nics_drl_bridge import extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.config import parse_namespace

EXIT_REFUSED = 1
CONSENT_S = 60.0  # default time for a node to appear and to consent [s]

WaitOption = Annotated[
    float,
    Option(min=0.0, help="Maximum time to wait for the node and for its consent [s]."),
]
_tell = partial(typer.echo, err=True)


def arm(
    namespace: console.NamespaceOption = "",
    reset: Annotated[bool, Option("--reset")] = False,
    wait: WaitOption = CONSENT_S,
    as_json: console.JsonOption = False,
) -> None:
    """Arms command_gate, or explains why it refuses.

    Args:
        reset: First release a latched stop, for example after nics stop.

    Examples:
        nics arm
        nics arm --reset --namespace ant
    """
    parse_namespace(namespace)
    with extensions.require_modules("nics arm"):
        from nics_drl_bridge.nodes.operator import Operator
    with Operator() as operator:
        answer = operator.arm(namespace, wait, reset, _tell)
    if not answer.granted:
        typer.echo(f"nics: {answer.node} refuses to arm: {answer.told}", err=True)
        raise typer.Exit(EXIT_REFUSED)
    line = f"{answer.node} is armed: the robot moves when its policy has a goal"
    console.print_line(as_json, line, gate=answer.node, armed=True)


def stop(
    namespace: str | None = None,
    wait: WaitOption = 5.0,
    as_json: console.JsonOption = False,
) -> None:
    """Stops one robot, or all, through the emergency stop of its gate.

    Args:
        namespace: Namespace of the robot to stop. Default: all robots.

    Examples:
        nics stop
        nics stop --namespace ant
    """
    parse_namespace(namespace or "")
    with extensions.require_modules("nics stop"):
        from nics_drl_bridge.nodes.operator import Operator
    stopped = {}
    with Operator() as operator:
        # All gates are called before anything is printed, because a paused terminal blocks.
        answers = list(operator.stop(namespace, wait))
    for answer in answers:
        stopped[answer.node] = answer.granted
        if not answer.granted:
            _tell(f"nics: {answer.node} was NOT stopped: {answer.told}")
        elif not as_json:
            typer.echo(_describe_stop(answer.node))
    if as_json:
        console.print_line(as_json, "", stopped=stopped)
    if not all(stopped.values()):
        raise typer.Exit(EXIT_REFUSED)


def _describe_stop(gate: str) -> str:
    space = gate.rpartition("/")[0].strip("/")
    rearm = f"nics arm --reset{f' --namespace {space}' if space else ''}"
    return f"{gate} has stopped its robot; `{rearm}` lets it drive again"


def goal(
    x: float,
    y: float,
    yaw: float = 0.0,
    frame: Annotated[str, Option(metavar="FRAME")] = "",
    namespace: console.NamespaceOption = "",
    wait: WaitOption = CONSENT_S,
    as_json: console.JsonOption = False,
) -> None:
    """Sends a goal, and reports whether policy_node accepts it.

    Args:
        x: Ahead, along the x axis of the frame [m].
        y: To the left, along its y axis [m].
        yaw: Heading at the goal [rad]; policies of this package ignore it.
        frame: Frame of the goal: map (default), odom, base_link, ...

    Examples:
        nics goal 1 0
        nics goal 2 -0.5 --frame base_link --namespace ant
    """
    parse_namespace(namespace)
    with extensions.require_modules("nics goal"):
        from nics_drl_bridge.nodes.operator import GoalRequest, Operator
    with Operator() as operator:
        answer = operator.send_goal(
            namespace, GoalRequest(x, y, yaw, frame), wait, _tell
        )
    if not answer.granted:
        typer.echo(f"nics: policy_node rejects the goal: {answer.told}", err=True)
        raise typer.Exit(EXIT_REFUSED)
    line = f"policy_node drives to {answer.told} as long as command_gate is armed"
    console.print_line(as_json, line, taken=True, goal=answer.told)
