"""Makes `docs/three_worlds.gif`: one policy drives the same episodes in three worlds, side by side.

In process, over DDS against `simulator_node`, and over DDS against a robot in MuJoCo. It needs the
extras `ros`, `mujoco` and `deploy`, and takes some minutes:

    python docs/three_worlds.py
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from itertools import zip_longest
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nics_drl_bridge.commands.episodes import LABELS, PLACES, drive_in
from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.rendering import WorldPicture
from nics_drl_bridge.policy.evaluation import Episode
from nics_drl_bridge.watch.record import Pixels, join_side_by_side, write_gif

POLICY = "differential"
WORLD = "clutter"
SEEDS = (1_000_002, 1_000_004, 1_000_005)
OUT = Path(__file__).with_name("three_worlds.gif")
SIDE = 300
HEAD = 26
FPS = 12
STANDS = 8


def drawn(
    env: BridgeEnv, picture: WorldPicture, place: str, episode: Episode
) -> Iterator[Pixels]:
    """Pictures of an episode; what the lidar saw is computed from where the robot was."""
    font = ImageFont.load_default(15)
    for k, pose in enumerate(episode.path):
        env.reset(seed=episode.seed, options={"start": pose})
        shot = picture.draw(env.snapshot(), [episode.path[: k + 1, :2]])
        height = round(SIDE * shot.shape[0] / shot.shape[1])
        image = Image.new("RGB", (SIDE, height + HEAD), "white")
        scaled = Image.fromarray(shot).resize((SIDE, height), Image.Resampling.LANCZOS)
        image.paste(scaled, (0, HEAD))
        end = f": {episode.result}" if k == len(episode.path) - 1 else ""
        title = f"{LABELS[place]}{end}"
        ImageDraw.Draw(image).text((SIDE / 2, 5), title, "#17202a", font, anchor="ma")
        yield np.asarray(image)


def main() -> None:
    """Drives, draws and writes."""
    with tempfile.TemporaryDirectory() as logs:
        runs = {}
        for place in PLACES:
            given = place, POLICY, POLICY, WORLD, SEEDS, Path(logs)
            runs[place] = drive_in(
                *given, lambda _: None, lambda line: sys.stderr.write(f"{line}\n")
            )
    frames: list[Pixels] = []
    with closing(BridgeEnv(model=POLICY, world=WORLD)) as env:
        picture = WorldPicture(env.model, env.world)
        for n in range(len(SEEDS)):
            rows = [
                list(drawn(env, picture, place, some[n]))
                for place, some in runs.items()
            ]
            last = [row[-1] for row in rows]
            for shown in (*zip_longest(*rows), *[last] * STANDS):
                held = [
                    one if one is not None else end
                    for one, end in zip(shown, last, strict=True)
                ]
                frames.append(join_side_by_side(held))
    write_gif(OUT, frames, FPS)


if __name__ == "__main__":
    main()
