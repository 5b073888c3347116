"""Files of what the page shows: MP4, GIF, and `.rrd` for Rerun's viewer."""

import io
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nics_drl_bridge import geometry
from nics_drl_bridge.env.rendering import WorldPicture
from nics_drl_bridge.env.snapshot import hits_of
from nics_drl_bridge.errors import ConfigError, nearest
from nics_drl_bridge.extensions import require
from nics_drl_bridge.files import check_above, whole_file, write_bytes
from nics_drl_bridge.lidar.exact_kernels import HEADING, RADIUS, SHAPE, X, Y
from nics_drl_bridge.watch.frame import Frame, Stage, WorldFrame

Pixels = NDArray[np.uint8]  # (H, W, 3)
COLOURS = 128  # of a GIF, whose size grows with them
ALIKE = 12  # difference of two colours of which a GIF has one
SAMPLES = 12  # frames that its colours are taken from
CORNERS = 24  # of a disc


def pictures(stage: Stage, frames: Iterable[Frame]) -> Iterator[Pixels]:
    """Draws frames, their worlds side by side."""
    drawn: dict[int, WorldPicture] = {}
    first = np.cumsum([0, *(len(world.members) for world in stage.worlds)])
    for frame in frames:
        row = []
        for world in frame.worlds:
            n = int(np.searchsorted(first, world.place, side="right")) - 1
            if n not in drawn:
                drawn[n] = WorldPicture(stage.model, stage.worlds[n])
            row.append(drawn[n].draw(world.shot, world.trails))
        yield beside(row)


def beside(row: list[Pixels]) -> Pixels:
    """Pictures side by side, of even sides, as videos need."""
    height = -(-max(len(each) for each in row) // 2) * 2
    width = -(-sum(each.shape[1] for each in row) // 2) * 2
    whole = np.full((height, width, 3), 255, np.uint8)
    left = 0
    for each in row:
        whole[: len(each), left : left + each.shape[1]] = each
        left += each.shape[1]
    return whole


def write_gif(path: Path, shown: Iterable[Pixels], fps: float) -> None:
    """Writes a GIF that repeats for ever."""
    every = list(shown)
    palette = palette_of(
        every[:: -(-len(every) // SAMPLES)]
    )  # one for all, or colours flicker
    first, *rest = [
        Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE)
        for each in every
    ]
    buffer = io.BytesIO()
    duration = round(1000.0 / fps)
    first.save(
        buffer, "GIF", save_all=True, append_images=rest, duration=duration, loop=0
    )
    write_bytes(path, buffer.getvalue())


def palette_of(some: list[Pixels]) -> Image.Image:
    """Palette of the most frequent colours that differ: means would lose those of small things."""
    parts = np.concatenate([each.reshape(-1, 3) for each in some]).astype(np.int64)
    colours, counts = np.unique(
        parts @ np.array([1 << 16, 1 << 8, 1]), return_counts=True
    )
    best = colours[np.argsort(-counts)]
    rows = np.stack([best >> 16, best >> 8 & 255, best & 255], axis=1)
    chosen = rows[:0]
    while len(rows) and len(chosen) < COLOURS:
        chosen = np.concatenate([chosen, rows[:1]])
        rows = rows[np.abs(rows - rows[0]).max(axis=1) > ALIKE]
    palette = Image.new("P", (1, 1))
    palette.putpalette(chosen.ravel().tolist())
    return palette


def write_mp4(path: Path, shown: Iterable[Pixels], fps: float) -> None:
    """Writes an MP4 (H.264), completely or not at all."""
    import imageio_ffmpeg

    shown = iter(shown)
    first = next(shown)
    height, width = first.shape[:2]
    with whole_file(path) as part:
        options = {
            "fps": fps,
            "macro_block_size": 2,
            "quality": 8,
            "ffmpeg_log_level": "error",
        }
        with closing(
            imageio_ffmpeg.write_frames(str(part), (width, height), **options)
        ) as video:
            video.send(None)
            for each in chain([first], shown):
                video.send(np.ascontiguousarray(each))


def write_rrd(path: Path, stage: Stage, frames: Iterable[Frame]) -> None:
    """Writes a recording of Rerun."""
    import rerun

    with (
        whole_file(path) as part,
        rerun.RecordingStream("nics_drl_bridge") as recording,
    ):
        recording.save(str(part))
        members = [member for world in stage.worlds for member in world.members]
        for frame in frames:
            recording.set_time("time", duration=frame.time_s)
            for n, world in enumerate(frame.worlds):
                _log(rerun, recording, f"world_{n}", stage, world)
                walls = members[world.place].all_walls().reshape(-1, 2, 2)
                recording.log(f"world_{n}/walls", rerun.LineStrips2D(walls * FLIP))
        recording.flush()


FLIP = np.array([1.0, -1.0])  # Rerun draws y downwards


def _log(rerun: Any, recording: Any, at: str, stage: Stage, world: WorldFrame) -> None:
    shot = world.shot
    model = stage.model
    shapes = [shape for each in stage.worlds for shape in each.shapes]
    bodies = [
        FLIP
        * _ring(
            body[[X, Y, HEADING]], body[RADIUS], shapes[int(body[SHAPE]) % len(shapes)]
        )
        for body in shot.bodies
        if body[RADIUS] > 0.0
    ]
    recording.log(
        f"{at}/obstacles", rerun.LineStrips2D(bodies, colors=[0x8D, 0x99, 0xAE])
    )
    recording.log(
        f"{at}/goals",
        rerun.Points2D(FLIP * shot.goals, radii=0.1, colors=[230, 159, 0]),
    )
    for m, (pose, ranges) in enumerate(zip(shot.poses, shot.ranges, strict=True)):
        robot = model.robot
        own = f"{at}/robot_{m}"
        ring = _ring(pose, robot.footprint_radius, robot)
        recording.log(
            f"{own}/footprint", rerun.LineStrips2D([FLIP * ring], colors=[0, 114, 178])
        )
        hits = hits_of(model.lidar, pose, ranges)
        recording.log(
            f"{own}/scan", rerun.Points2D(FLIP * hits, radii=0.02, colors=[213, 94, 0])
        )
        if world.trails:
            way = [FLIP * world.trails[m]]
            recording.log(f"{own}/trail", rerun.LineStrips2D(way, colors=[0, 158, 115]))
        for c, command in enumerate(model.robot.command):
            if shot.commands is not None:
                value = rerun.Scalars(float(shot.commands[m, c]))
                recording.log(f"{own}/commands/{command.name}", value)


def _ring(pose: Any, radius: float, shape: Any) -> NDArray[np.float64]:
    """Closed outline (V + 1, 2) of a shape, or of a robot by its footprint, at a pose (3,)."""
    outline: Any = getattr(shape, "footprint", None)
    if outline is None:
        outline = np.asarray(getattr(shape, "outline", np.zeros((0, 2))))
        outline = outline * (radius / shape.radius) if len(outline) else outline
    corners = np.array(outline, np.float64)
    if not len(corners):
        turns = np.linspace(0.0, 2.0 * np.pi, CORNERS, endpoint=False)
        corners = radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.asarray(
        geometry.rotate(np.concatenate([corners, corners[:1]]), pose[2]) + pose[:2]
    )


LIBRARIES = {".mp4": ("imageio_ffmpeg",), ".rrd": ("rerun",)}
WRITERS: dict[str, Callable[[Path, Stage, Iterable[Frame], float], None]] = {
    ".gif": lambda path, stage, frames, fps: write_gif(
        path, pictures(stage, frames), fps
    ),
    ".mp4": lambda path, stage, frames, fps: write_mp4(
        path, pictures(stage, frames), fps
    ),
    ".rrd": lambda path, stage, frames, _: write_rrd(path, stage, frames),
}


def check_file(path: Path) -> None:
    """Raises ConfigError for a kind that is unknown or lacks its library, or a bad folder."""
    if path.suffix not in WRITERS:
        raise ConfigError(f"--record {str(path)!r}: {nearest(path.suffix, WRITERS)}")
    require(str(path), *LIBRARIES.get(path.suffix, ()))
    check_above(path)


def write(path: Path, stage: Stage, frames: Iterable[Frame], fps: float) -> None:
    """Writes frames to a file whose suffix tells its kind. Raises ConfigError."""
    check_file(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[path.suffix](path, stage, frames, fps)
