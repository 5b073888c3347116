"""`nics world`: imports worlds from other tools, draws worlds, and writes their maps."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from typer import Argument, Option

from nics_drl_bridge import defaults
from nics_drl_bridge.commands import console
from nics_drl_bridge.commands.first_checks import check_suffix
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import format_json, write_text
from nics_drl_bridge.robot import DEFAULT_ROBOT

if TYPE_CHECKING:
    from nics_drl_bridge.sim.sdf import Standing

world = typer.Typer(
    help="Imports worlds made by other tools, draws worlds, writes maps.",
    no_args_is_help=True,
)

SDF = (".world", ".sdf")
MAPS = (".yaml", ".yml")
PICTURES = (".png", ".pgm", ".bmp")
# default height of the imported plane [m]; TurtleBot3's lidar is at 0.18 m
HEIGHT = 0.2
NAV2 = {
    "origin": [0.0, 0.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
}
KEYS = (  # of a world file, in this order
    "name",
    "map",
    "bounds",
    "obstacles",
    "clearance",
    "goal_distance",
    "starts",
    "goals",
)
Keys = dict[str, Any]  # keys of a YAML file
Shown = Annotated[
    str,
    Argument(
        metavar="WORLD",
        help="A shipped world, a YAML file, or a set of worlds.",
        autocompletion=console.WORLDS,
    ),
]


class Written(NamedTuple):
    """A file to write."""

    path: Path
    text: str
    line: str  # describes its content


@world.command("import")
def import_(
    files: Annotated[list[Path], Argument(metavar="FILE...")],
    out: Path | None = None,
    name: str | None = None,
    start: Annotated[
        tuple[float, float, float] | None, Option(metavar="X Y HEADING")
    ] = None,
    goal: Annotated[tuple[float, float] | None, Option(metavar="X Y")] = None,
    goal_distance: Annotated[
        tuple[float, float] | None,
        Option(
            metavar="MIN MAX",
            help="Distance from start to goal [m]. Default: at least "
            f"{defaults.IMPORT_GOAL_DISTANCE_M:g} m.",
        ),
    ] = None,
    clearance: float = defaults.IMPORT_CLEARANCE_M,
    height: float = HEIGHT,
    bounds: Annotated[
        tuple[float, float, float, float] | None, Option(metavar="X1 Y1 X2 Y2")
    ] = None,
    without: Annotated[list[str] | None, Option(metavar="MODEL")] = None,
    skip_unknown: Annotated[bool, Option("--skip-unknown")] = False,
    resolution: float | None = None,
    as_json: console.JsonOption = False,
) -> None:
    """Imports Gazebo worlds, Nav2 maps, or pictures as worlds.

    Args:
        files: Gazebo's .world or .sdf, Nav2's map .yaml, or a picture.
        out: The .yaml to write, or a folder. Default: this folder, named after the file.
        name: Name of the world. Default: that of the file.
        start: Where robots start [m, rad]. Default: anywhere.
        goal: Position of the goal [m]. Default: anywhere.
        clearance: Free space around the footprint [m].
        height: For SDF: height of the lidar above z = 0, at which geometry is cut [m].
        bounds: For SDF: bounds of the field [m]. Default: around all obstacles.
        without: For SDF: a model to leave out, such as a robot; * matches anything.
            Repeatable.
        skip_unknown: For SDF: skip and list meshes and other unsupported shapes.
        resolution: For a picture: side of a pixel [m].

    Examples:
        nics world import house.world --out house.yaml
    """
    from nics_drl_bridge.sim.sdf import read_sdf

    keys = {
        "name": name,
        "bounds": bounds,
        "clearance": clearance,
        "goal_distance": goal_distance,
        "starts": start and {"at": [start]},
        "goals": goal and {"at": [goal]},
    }
    keys = {key: value for key, value in keys.items() if value is not None}
    written = list[Written]()
    for file, place in _places(files, out, name).items():
        if file.suffix.lower() in SDF:
            standing = read_sdf(file, height, tuple(without or ()), skip_unknown)
            written.append(_read_standing(file, place, standing, keys, height))
        else:
            written += _read_mapped(file, place, keys, resolution)
    for output in written:
        if output.path.exists():
            fix = "remove it, or give another --out"
            raise ConfigError(f"{output.path}: already exists; {fix}.")
    for output in written:
        write_text(output.path, output.text)
        if not as_json:
            typer.echo(f"{output.path}: {output.line}")
    if as_json:
        facts = [{"file": str(output.path), "holds": output.line} for output in written]
        typer.echo(format_json({"worlds": facts}))


def _places(files: list[Path], out: Path | None, name: str | None) -> dict[Path, Path]:
    """Returns the file to write for each file to read. Raises ConfigError."""
    is_file = out is not None and out.suffix in MAPS
    if len(files) > 1 and (is_file or name is not None):
        option = f"--out {out}" if is_file else f"--name {name}"
        problem = f"{option}: is for one file, not for {len(files)}"
        raise ConfigError(f"{problem}; give a folder as --out.")
    if out is not None and is_file:
        return {files[0]: out}
    ends = [".yaml" if file.suffix.lower() in SDF else "_world.yaml" for file in files]
    places = [
        (out or Path()) / f"{file.stem}{end}"
        for file, end in zip(files, ends, strict=True)
    ]
    twice = {str(place) for place in places if places.count(place) > 1}
    if twice:
        raise ConfigError(
            f"{min(twice)}: two worlds would be written to it; import them one by one."
        )
    return dict(zip(files, places, strict=True))


def _read_standing(
    file: Path, place: Path, standing: "Standing", keys: Keys, height: float
) -> Written:
    """Returns the world of the obstacles in an SDF file."""
    at = [keys[key]["at"][0] for key in ("starts", "goals") if key in keys]
    field = keys.get("bounds") or standing.bounds(*at)
    size = (field[2] - field[0], field[3] - field[1])
    groups = [
        {"shapes": [group.shapes[0].model_dump(exclude_none=True)], "at": group.at}
        for group in standing.obstacles
    ]
    head = [f"Obstacles of {file.name} at a height of {height:g} m."]
    head += [f"Left out: {reason}." for reason in standing.left_out]
    derived = {"name": file.stem, "bounds": field, "obstacles": groups}
    text = _format_world(file, head, derived | keys, size)
    line = (
        f"obstacles: {len(standing.placed)}, field: {size[0]:.4g} m x {size[1]:.4g} m"
    )
    return Written(place, text, "\n  left out: ".join([line, *standing.left_out]))


def _read_mapped(
    file: Path, place: Path, keys: Keys, resolution: float | None
) -> list[Written]:
    """Returns the world of a map, preceded by a new map file for a picture with a resolution."""
    from nics_drl_bridge.config import dump_yaml, validate
    from nics_drl_bridge.lidar.maps import MapFile, load_map, read_image

    if file.suffix not in MAPS and file.suffix.lower() not in PICTURES:
        kinds = ", ".join((*SDF, *MAPS, *PICTURES))
        raise ConfigError(f"{file}: unknown kind of file; give one of {kinds}.")
    map_file = file.with_suffix(".yaml") if file.suffix.lower() in PICTURES else file
    files = []
    if file.suffix.lower() in PICTURES and resolution is not None:
        map_file = place.with_name(f"{place.stem}_map.yaml")
        about = {"image": _locate_from(place, file), "resolution": resolution, **NAV2}
        validate(about, MapFile, f"--resolution {resolution:g}")
        rows, columns = read_image(file, str(file))[0].shape
        files = [Written(map_file, dump_yaml(about), f"the map of {file.name}")]
    elif map_file.is_file() or file.suffix in MAPS:
        grid = load_map(map_file)
        (rows, columns), resolution = grid.cells.shape, grid.resolution
    else:
        fix = "give the side of its pixels in metres as --resolution"
        raise ConfigError(
            f"{file}: there is no {map_file.name} beside the picture; {fix}."
        )
    size = (columns * resolution, rows * resolution)
    derived = {"name": file.stem, "map": _locate_from(place, map_file)}
    text = _format_world(file, [f"The map {map_file.name}."], derived | keys, size)
    return [*files, Written(place, text, f"map: {size[0]:.4g} m x {size[1]:.4g} m")]


def _locate_from(place: Path, file: Path) -> str:
    return os.path.relpath(file.resolve(), place.parent.resolve())


def _format_world(
    file: Path, head: list[str], values: Keys, size: tuple[float, float]
) -> str:
    """Returns the text of a world file, after reading it back as a check.

    Raises ConfigError that names the imported file, because the new one does not exist yet.
    """
    from nics_drl_bridge.config import dump_yaml, parse_yaml, validate
    from nics_drl_bridge.sim.world import World, check_places

    far = round(math.hypot(*size), 3)
    least = min(defaults.IMPORT_GOAL_DISTANCE_M, round(far / 4.0, 3))
    if {"starts", "goals"} <= set(values):
        least = 0.0
    values = {"goal_distance": (least, far), **values}
    comments = [f"# {' '.join(line.split())}\n" for line in head]
    ordered = {key: values[key] for key in KEYS if key in values}
    text = "".join(comments) + dump_yaml(ordered, one_line_rows=True)
    obstacles = sum(len(group["at"]) for group in values.get("obstacles", ()))
    made = f"{file}: the world made of it"
    try:
        data = parse_yaml(text, made)
    except ConfigError:
        if not obstacles:
            raise
        raise ConfigError(
            f"{file}: its {obstacles} bodies make a file that is too large to be read; "
            "leave some out by --without MODEL, or split the world."
        ) from None
    world = validate(data, World, made)
    if world.map is None:
        world._file = made
        check_places(world)
    return text


@world.command()
def draw(
    name: Shown,
    out: Path | None = None,
    seed: console.SeedOption = 0,
    robot: console.RobotOption = DEFAULT_ROBOT,
    footprint: float | None = None,
    as_json: console.JsonOption = False,
) -> None:
    """Draws the world of an episode, with start and goal.

    For a set, such as barn or a folder of files, it draws the world of the episode.

    Args:
        out: File to write. Default: <world>_drawn.png.
        seed: Seed of the episode.
        robot: A shipped robot (see nics list robots) or a YAML file.
        footprint: Draw a round robot of this radius instead [m].

    Examples:
        nics world draw clutter --seed 3
    """
    with console.show_progress():
        from nics_drl_bridge.files import write_bytes
        from nics_drl_bridge.report.pictures import draw_seeded_world
        from nics_drl_bridge.robot.spec import load_robot
        from nics_drl_bridge.sim.scenes import member_of
        from nics_drl_bridge.sim.world_set import load_worlds

        worlds = load_worlds(name)
    opened = worlds.members[member_of(worlds, seed)]
    driven = load_robot(robot)
    outline = driven.footprint if footprint is None else None
    radius = driven.footprint_radius if footprint is None else footprint
    if not 0.0 < radius < math.inf:
        raise ConfigError(f"--footprint {radius:g}: must be above 0 m.")
    file = out or Path(Path(f"{opened.name}_drawn.png").name)
    check_suffix("--out", file, ".png")
    _check_overwrite(worlds, Path(name), file)
    write_bytes(file, draw_seeded_world(opened, radius, seed, outline))
    facts = {"file": str(file), "world": opened.name, "seed": seed}
    console.print_line(
        as_json, f"{file}: the world {opened.name!r}, seed {seed}", **facts
    )


def _check_overwrite(worlds: Any, given: Path, *written: Path) -> None:
    """Raises ConfigError if a file to write would replace one of the world's own files."""
    from nics_drl_bridge.lidar.maps import files_of

    for member in worlds.members:
        sources = (
            given,
            Path(member.source),
            *(files_of(member.map) if member.map else ()),
        )
        own_files = {path.resolve() for path in sources}
        for file in written:
            if file.resolve() in own_files:
                raise ConfigError(
                    f"{file.resolve()}: is a file of the world itself; give another --out."
                )


@world.command("map")
def map_(
    name: Shown,
    out: Path | None = None,
    seed: console.SeedOption = 0,
    robot: console.RobotOption = DEFAULT_ROBOT,
    resolution: float = 0.01,
    as_json: console.JsonOption = False,
) -> None:
    """Writes the map of an episode for Nav2's map_server.

    Moving obstacles are omitted. `nics world map room`, then `ros2 run nav2_map_server
    map_server --ros-args -p yaml_filename:=room_map.yaml`.

    Args:
        out: File to write. Default: <world>_map.yaml.
        seed: Seed of the episode.
        robot: A shipped robot (see nics list robots) or a YAML file.
        resolution: Maximum side of a cell [m].

    Examples:
        nics world map room --out room_map.yaml
    """
    with console.show_progress():
        from nics_drl_bridge.lidar.maps import map_files
        from nics_drl_bridge.robot.spec import load_robot
        from nics_drl_bridge.sim.occupancy import occupancy, standing
        from nics_drl_bridge.sim.scenes import SceneSampler
        from nics_drl_bridge.sim.world_set import load_worlds

    if not 1e-3 <= resolution <= 100.0:
        raise ConfigError(f"--resolution {resolution:g}: must be from 0.001 to 100 m.")
    worlds = load_worlds(name)
    sampler = SceneSampler(worlds, load_robot(robot).footprint_radius)
    scenes = sampler.draw([seed])
    member = int(scenes.member[0])
    opened = worlds.members[member]
    file = out or Path(Path(f"{opened.name}_map.yaml").name)
    check_suffix("--out", file, *MAPS)
    _check_overwrite(worlds, Path(name), file, file.with_suffix(".pgm"))
    grid = occupancy(opened, standing(sampler, member, scenes[0].bodies), resolution)
    map_files(grid, file)
    rows, columns = grid.cells.shape
    size = f"{columns} x {rows} cells of {grid.resolution:.4g} m"
    facts = {
        "file": str(file),
        "world": opened.name,
        "seed": seed,
        "cells": [columns, rows],
    }
    line = f"{file}: the map of {opened.name!r}, seed {seed}, {size}"
    console.print_line(as_json, line, **facts, resolution_m=grid.resolution)
