"""Writes what the page shows as MP4 or GIF."""

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
COLOURS = 128  # maximum number of colours of a GIF, which limits its size
SAMPLES = 12  # number of frames that colours are taken from


def draw_frames(stage: Stage, frames: Iterable[Frame]) -> Iterator[Pixels]:
    """Draws frames, with worlds side by side."""
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
    """Joins pictures side by side, to an even height and width as required by videos."""
    height = -(-max(len(picture) for picture in row) // 2) * 2
    width = -(-sum(picture.shape[1] for picture in row) // 2) * 2
    joined = np.full((height, width, 3), 255, np.uint8)
    left = 0
    for picture in row:
        right = left + picture.shape[1]
        joined[: len(picture), left:right] = picture
        left = right
    return joined


def write_gif(path: Path, shown: Iterable[Pixels], fps: float) -> None:
    """Writes a GIF that repeats for ever."""
    pictures = list(shown)
    # All frames share one palette, or colours would flicker; it keeps those of small objects.
    samples = np.concatenate(pictures[:: -(-len(pictures) // SAMPLES)])
    palette = Image.fromarray(samples).quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *rest = [
        Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)
        for pixels in pictures
    ]
    buffer = io.BytesIO()
    duration = round(1000.0 / fps)
    first.save(
        buffer, "GIF", save_all=True, append_images=rest, duration=duration, loop=0
    )
    write_bytes(path, buffer.getvalue())


def write_mp4(path: Path, shown: Iterable[Pixels], fps: float) -> None:
    """Writes an MP4 (H.264), completely or not at all."""
    import imageio_ffmpeg

    shown = iter(shown)
    first = next(shown)
    height, width = first.shape[:2]
    with write_whole_file(path) as part:
        video = imageio_ffmpeg.write_frames(
            str(part),
            (width, height),
            fps=fps,
            macro_block_size=2,
            quality=8,
            ffmpeg_log_level="error",
        )
        with closing(video):
            video.send(None)
            for pixels in chain([first], shown):
                video.send(np.ascontiguousarray(pixels))


LIBRARIES = {".mp4": ("imageio_ffmpeg",)}
WRITERS: dict[str, Callable[[Path, Iterable[Pixels], float], None]] = {
    ".gif": write_gif,
    ".mp4": write_mp4,
}


def check_file(path: Path) -> None:
    """Raises ConfigError for an unknown suffix, a missing library, or a bad folder."""
    if path.suffix not in WRITERS:
        raise ConfigError(f"--record {str(path)!r}: {suggest(path.suffix, WRITERS)}")
    require(str(path), *LIBRARIES.get(path.suffix, ()))
    check_above(path)


def write(path: Path, stage: Stage, frames: Iterable[Frame], fps: float) -> None:
    """Writes frames to an MP4 or a GIF, by suffix. Raises ConfigError."""
    check_file(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    WRITERS[path.suffix](path, draw_frames(stage, frames), fps)
