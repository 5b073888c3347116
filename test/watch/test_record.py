from __future__ import annotations

import sys
from contextlib import closing

import numpy as np
import pytest
from PIL import Image, ImageColor

from nics_drl_bridge.env.rendering import ROBOTS
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.style import GOAL
from nics_drl_bridge.watch.record import check_file, join_side_by_side, write
from watch.rig import source


def frames(made, count=4):
    for _ in range(count):
        yield made.frame()
        made.advance()


@pytest.fixture
def made():
    with closing(source()) as running:
        yield running


def test_a_gif_has_each_frame_and_moves(made, tmp_path):
    path = tmp_path / "new" / "episode.gif"
    write(path, made.stage(), frames(made), 10.0)
    with Image.open(path) as image:
        assert (image.n_frames, image.info["duration"], image.info["loop"]) == (
            4,
            100,
            0,
        )
        shown = []
        for n in range(4):
            image.seek(n)
            shown.append(np.asarray(image.convert("RGB"), int))
    assert shown[0].shape == (500, 500, 3)
    assert np.abs(shown[0] - shown[3]).max() > 50
    for colour in (ROBOTS[0], GOAL):
        off = np.abs(shown[0] - ImageColor.getrgb(colour)).max(axis=-1)
        assert (off <= 6).sum() > 20


def test_an_mp4_has_each_frame(made, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")
    path = tmp_path / "episode.mp4"
    write(path, made.stage(), frames(made, 6), 10.0)
    assert [file.name for file in tmp_path.iterdir()] == ["episode.mp4"]
    count, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert (count, seconds) == (6, pytest.approx(0.6, abs=0.05))


def test_worlds_stand_side_by_side_in_a_picture_of_even_sides():
    whole = join_side_by_side(
        [np.zeros((5, 3, 3), np.uint8), np.ones((2, 4, 3), np.uint8)]
    )
    assert whole.shape == (6, 8, 3)
    assert (whole[:5, :3] == 0).all()
    assert (whole[:2, 3:7] == 1).all()
    assert (whole[5:] == 255).all()


def test_a_missing_library_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ConfigError, match=r"pip install 'nics_drl_bridge\[video\]'"):
        check_file(tmp_path / "episode.mp4")  # before anything is driven


def test_a_failure_leaves_no_part_of_a_file(made, tmp_path):
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra 'video'")

    def broken():
        yield made.frame()
        raise ConfigError("no further frame.")

    with pytest.raises(ConfigError, match="no further frame"):
        write(tmp_path / "episode.mp4", made.stage(), broken(), 10.0)
    assert list(tmp_path.iterdir()) == []
