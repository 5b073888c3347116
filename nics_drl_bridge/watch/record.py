"""Files of what the page shows: MP4 and GIF."""

import io
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nics_drl_bridge.env.rendering import WorldPicture
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.extensions import require
from nics_drl_bridge.files import check_above, write_bytes, write_whole_file
from nics_drl_bridge.watch.frame import Frame, Stage

Pixels = NDArray[np.uint8]  # (H, W, 3)
COLOURS = 128  # of a GIF, whose size grows with them
ALIKE = 12  # difference of two colours of which a GIF has one
SAMPLES = 12  # frames that its colours are taken from


def draw_frames(stage: Stage, frames: Iterable[Frame]) -> Iterator[Pixels]:
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
        yield join_side_by_side(row)


def join_side_by_side(row: list[Pixels]) -> Pixels:
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
    palette = choose_palette(
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


def choose_palette(some: list[Pixels]) -> Image.Image:
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
    with write_whole_file(path) as part:
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


LIBRARIES = {".mp4": ("imageio_ffmpeg",)}
WRITERS: dict[str, Callable[[Path, Stage, Iterable[Frame], float], None]] = {
    ".gif": lambda path, stage, frames, fps: write_gif(
        path, draw_frames(stage, frames), fps
    ),
    ".mp4": lambda path, stage, frames, fps: write_mp4(
        path, draw_frames(stage, frames), fps
    ),
}


def check_file(path: Path) -> None:
    """Raises ConfigError for a kind that is unknown or lacks its library, or a bad folder."""
    if path.suffix not in WRITERS:
        raise ConfigError(f"--record {str(path)!r}: {suggest(path.suffix, WRITERS)}")
    require(str(path), *LIBRARIES.get(path.suffix, ()))
    check_above(path)


def write(path: Path, stage: Stage, frames: Iterable[Frame], fps: float) -> None:
    """Writes frames to a file whose suffix tells its kind. Raises ConfigError."""
    check_file(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[path.suffix](path, stage, frames, fps)
