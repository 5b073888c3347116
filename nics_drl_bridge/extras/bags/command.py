"""`nics bag record|info|replay|export`."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.robot import DEFAULT_ROBOT

bag = typer.Typer(
    help="Records, describes, replays, exports bags.", no_args_is_help=True
)

BagArgument = Annotated[Path, Argument(help="Folder or file of a rosbag2.")]
StorageOption = Annotated[
    Literal["mcap", "sqlite3"],
    Option(help="mcap (checksums) or sqlite3.", metavar="mcap|sqlite3"),
]


@bag.command()
def record(
    out: Path,
    topics: list[str] | None = None,
    everything: Annotated[bool, Option("--all")] = False,
    namespace: console.NamespaceOption = "",
    duration: Annotated[float | None, Option(min=0.0)] = None,
    storage: StorageOption = defaults.BAG_STORAGE,
    use_sim_time: console.SimTimeOption = False,
    as_json: console.JsonOption = False,
) -> None:
    """Records a robot's topics without driving it.

    Args:
        out: Folder of the bag to write.
        topics: A topic to record; repeatable.
        everything: Record every topic.
        duration: Stop after this time [s]; else at Ctrl-C.

    Examples:
        nics bag record drive --duration 60
    """
    with extensions.require_modules("nics bag record"):
        from nics_drl_bridge.extras.bags.live import BagOrder, record_bag
        from nics_drl_bridge.nodes.own_process import forward_errors
    names = tuple(topics or ())
    space = parse_namespace(namespace)
    order = BagOrder(out, names, everything, space, duration, storage, use_sim_time)
    with forward_errors():
        counts = record_bag(order, partial(typer.echo, err=True))
    counts = dict(sorted(counts.items()))
    lines = [f"{topic}: {count} messages" for topic, count in counts.items()]
    lines.append(f"bag written to {out}")
    console.print_line(as_json, "\n".join(lines), path=str(out), messages=counts)


@bag.command()
def info(
    path: BagArgument,
    as_json: console.JsonOption = False,
) -> None:
    """Shows a bag's topics, rates, gaps, and the clock of its stamps.

    Examples:
        nics bag info drive --json
    """
    from nics_drl_bridge.extras.bags.info import read_bag_info

    contents = read_bag_info(path)
    span = f"{contents.duration_s:.3f} s"
    size = f"{contents.size_bytes / 1e6:.2f} MB"
    line = f"{path}: {contents.messages} messages in {span}, {size}"
    heads = (
        "topic",
        "type",
        "count",
        "Hz",
        "from, to [s]",
        "gaps",
        "clock",
        "delay [ms]",
    )
    table = console.format_table(
        heads, [_format_row(topic) for topic in contents.topics]
    )
    console.print_line(
        as_json, f"{line}\n{table}", **asdict(contents) | {"path": str(path)}
    )


def _replay_estimator(
    path: Path, model: str, roles: list[str], out: Path | None, as_json: bool
) -> None:
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.middleware import playback

    estimates = playback.estimate(path, open_model(model), console.parse_roles(roles))
    if out is not None:
        playback.write_estimate(estimates, out)
    rejected = dict(sorted(estimates.rejected.items()))
    number = len(estimates.stamp_ns)
    x, y, heading = last = estimates.pose[-1].tolist()
    lines = [f"not used: {count} of {reason}" for reason, count in rejected.items()]
    lines.append(f"{number} estimates; the last is {x:.3f} m, {y:.3f} m, {heading:.3f}")
    facts = {"estimates": number, "last": last, "not_used": rejected}
    line = "\n".join((*lines, f"sha256 {estimates.digest}"))
    console.print_line(as_json, line, **facts, sha256=estimates.digest)


@bag.command()
def replay(
    path: BagArgument,
    rate: Annotated[float, Option(min=0.001)] = 1.0,
    loop: Annotated[bool, Option("--loop")] = False,
    clock: bool = True,
    topics: list[str] | None = None,
    namespace: str = "",
    lockstep: Annotated[str | None, Option(metavar="NODE")] = None,
    estimate: Annotated[bool, Option("--estimate")] = False,
    model: console.RobotOption = DEFAULT_ROBOT,
    topic: console.RolesOption = None,
    out: Path | None = None,
    as_json: console.JsonOption = False,
) -> None:
    """Plays a bag over ROS 2, or runs the middleware's estimator on it.

    Args:
        rate: Seconds of the bag per second.
        loop: Start again at the end.
        clock: Publish the bag's time on /clock.
        topics: Play this topic only; repeatable.
        namespace: Prefix of the topics' names.
        lockstep: Wait after each message until this node has received it.
        estimate: Run the middleware on the bag in process instead.
        model: For --estimate: folder of a model, or a shipped robot.
        out: For --estimate: .npz or .csv to write.

    Examples:
        nics bag replay drive --rate 2
    """
    if estimate:
        _replay_estimator(path, model, topic or [], out, as_json)
        return
    with extensions.require_modules("nics bag replay"):
        from nics_drl_bridge.extras.bags.live import PlayOrder, play_bag
    order = PlayOrder(path, topics or (), rate, loop, clock, namespace, lockstep)
    sent = play_bag(order, partial(typer.echo, err=True))
    console.print_line(as_json, f"{sent} messages were published", published=sent)


@bag.command()
def export(
    path: BagArgument,
    mcap: Annotated[Path, Option(metavar="FOLDER")],
    model: console.OptionalRobotOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Converts a bag to MCAP for Foxglove.

    Args:
        mcap: Write an MCAP bag for Foxglove.
        model: A model's folder, or a shipped robot: for its lidar's mount.

    Examples:
        nics bag export drive --mcap shown --model my_robot
    """
    from nics_drl_bridge.extras.bags.convert import convert
    from nics_drl_bridge.generator import open_model

    added = convert(path, mcap, None if model is None else open_model(model))
    also = f", with {' and '.join(added)} added" if added else ""
    console.print_line(
        as_json, f"bag written to {mcap}{also}", mcap=str(mcap), added=added
    )


def _format_row(topic: Any) -> tuple[str, ...]:
    span = "" if topic.first_s is None else f"{topic.first_s:.2f}, {topic.last_s:.2f}"
    if topic.longest_gap_s is None:
        gaps = ""
    else:
        gaps = f"{topic.gaps}, longest {topic.longest_gap_s:.2f} s"
    if topic.delay_s is None:
        delay = ""
    else:
        delay = f"{1e3 * topic.delay_s:.1f} ± {5e2 * topic.jitter_s:.1f}"
    rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.2f}"
    return (
        topic.topic,
        topic.type,
        str(topic.count),
        rate,
        span,
        gaps,
        topic.clock,
        delay,
    )
