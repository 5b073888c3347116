"""`nics watch`: shows episodes, live topics or a bag on a page, or records a video."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults, extensions
from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.interrupts import has_heard_ctrl_c
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot import DEFAULT_ROBOT

if TYPE_CHECKING:
    from nics_drl_bridge.commands.episodes import Conditions


def watch(
    policy: Annotated[
        str | None,
        Argument(
            help=f"A policy file, a shipped policy ({DEFAULT_ROBOT}, the default) or a baseline "
            "(dynamic_window).",
            autocompletion=console.POLICIES,
        ),
    ] = None,
    model: console.OptionalRobotOption = None,
    world: console.WorldsOption = None,
    seed: console.SeedOption = defaults.EVALUATION_SEED,
    lidar: console.LidarOption = None,
    randomisation: console.RandomisationOption = None,
    gate: console.GateOption = None,
    task: console.TaskOption = None,
    ros: Annotated[bool, Option("--ros")] = False,
    namespace: console.NamespaceOption = "",
    bag: Path | None = None,
    topic: console.RolesOption = None,
    record: Annotated[Path | None, Option(metavar="FILE")] = None,
    episodes: console.CountOption = 1,
    port: Annotated[int, Option(min=0, max=65535)] = defaults.PAGE_PORT,
    browser: bool = True,
) -> None:
    """Shows a policy, live topics or a bag on a page in the browser.

    Args:
        model: A model's folder, or a shipped robot. Default: the policy's.
        world: A shipped world (circles) or a YAML file; repeat to show several side by side.
        seed: Seed of the first episode.
        lidar: A shipped lidar (rplidar_a2) or a YAML file, instead of the model's.
        ros: Show live topics instead.
        bag: Show a recorded drive instead.
        record: Write a .mp4 or .gif file instead.
        episodes: For --record: number of episodes.
        port: Port of the page; 0 chooses a free one.
        browser: Open the page in a browser.

    Examples:
        nics watch differential --world circles
        nics watch --bag drive
        nics watch jackal --world clutter --record episode.gif
    """
    if record is None:  # first, because opening the source may take a while
        extensions.require("the page", "websockets")
    else:
        from nics_drl_bridge.watch.record import check_file

        check_file(record)
    if bag is not None:
        source: Any = _watch_bag(bag, model, world, console.parse_roles(topic or []))
    elif ros:
        source = _watch_ros(model, world, namespace)
    else:
        from nics_drl_bridge.commands.episodes import Conditions

        source = _watch_episodes(
            policy or DEFAULT_ROBOT,
            model,
            world or [defaults.EVALUATION_WORLD],
            seed,
            Conditions(lidar, randomisation, gate, kind=task),
        )
    with closing(source):
        if record is not None:
            _record(record, source, episodes)
        else:
            _serve(source, port, browser)


def _watch_episodes(
    policy: str,
    name: str | None,
    worlds: list[str],
    seed: int,
    conditions: "Conditions",
) -> Any:
    from nics_drl_bridge.commands import episodes as driving
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.sim.world_set import load_worlds
    from nics_drl_bridge.watch.episode import EpisodeSource

    robot = driving.model_name(name, driving.read_contracts([policy]))
    model = open_model(robot, conditions.lidar)

    def make(policy: str, world: Any) -> Any:
        contracts = driving.read_contracts([policy])
        limited = driving.limit_time(conditions, contracts, model, world, typer.echo)
        options = {"estimator": True, "randomisation": conditions.ranges}
        return driving.open_env(policy, model, world, "sim", limited, **options)

    return EpisodeSource(
        make, policy, [load_worlds(world) for world in worlds], seed, name or ""
    )


def _watch_bag(
    bag: Path, name: str | None, worlds: list[str] | None, topics: dict[str, str]
) -> Any:
    from nics_drl_bridge.generator import open_model
    from nics_drl_bridge.watch.bag import BagSource

    model = open_model(name or DEFAULT_ROBOT)
    return BagSource(bag, model, topics, _make_only_world(worlds), name or "")


def _watch_ros(name: str | None, worlds: list[str] | None, namespace: str) -> Any:
    from nics_drl_bridge.generator import open_model

    with extensions.require_modules("nics watch --ros"):
        from nics_drl_bridge.nodes.watching import RosSource
    model = open_model(name or DEFAULT_ROBOT)
    return RosSource(model, _make_only_world(worlds), namespace, model_name=name or "")


def _make_only_world(worlds: list[str] | None) -> Any:
    """Returns the only world given for a robot driven by others, if any."""
    if worlds is None:
        return None
    if len(worlds) > 1:
        raise ConfigError(
            f"--world {' '.join(worlds)}: a robot is in one world; give only that one."
        )
    from nics_drl_bridge.sim.world_set import load_worlds

    return load_worlds(worlds[0])


def _record(path: Path, source: Any, episodes: int) -> None:
    from nics_drl_bridge.watch.record import write

    def frames() -> Iterator[Any]:
        yield source.frame()
        while source.unfinished(episodes):
            source.advance()
            yield source.frame()

    write(path, source.stage(), frames(), 1.0 / source.period_s)
    typer.echo(f"wrote {path}")


def _serve(source: Any, port: int, browser: bool) -> None:
    from nics_drl_bridge.watch.server import PageServer
    from nics_drl_bridge.watch.show import open_page, show

    with closing(PageServer(port)) as server:
        open_page(server.url, browser)
        # Compiled code now and then swallows the KeyboardInterrupt of a Ctrl-C.
        show(source, server, has_heard_ctrl_c)
    if has_heard_ctrl_c():
        raise KeyboardInterrupt
