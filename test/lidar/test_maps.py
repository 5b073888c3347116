from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy import ndimage

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.lidar.maps import load_map

KEYS = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [-1.0, -2.0, 0.3],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
}
GREYS = np.array([[0, 50, 100, 150], [200, 205, 254, 255]], np.uint8)


@pytest.fixture
def save(tmp_path):
    """Writes an image and its YAML file; gives the path of the latter."""

    def write(image=GREYS, name="map.pgm", drop=(), **changes):
        if isinstance(image, bytes):
            (tmp_path / name).write_bytes(image)
        elif image is not None:
            Image.fromarray(image).save(tmp_path / name)
        keys = {
            key: v
            for key, v in (KEYS | {"image": name} | changes).items()
            if key not in drop
        }
        lines = [f"{key}: {value}\n" for key, value in keys.items()]
        (tmp_path / "map.yaml").write_text("".join(lines))
        return tmp_path / "map.yaml"

    return write


def cells(path):
    """As the image shows them: the last row of the map first."""
    return load_map(path).cells[::-1].tolist()


def test_a_trinary_map_is_black_occupied_white_free_and_grey_unknown(save):
    grid = load_map(save())
    assert grid.cells[::-1].tolist() == [[100, 100, -1, -1], [0, 0, 0, 0]]
    assert grid.resolution == 0.05
    assert grid.origin == (-1.0, -2.0, 0.3)
    assert load_map(save(mode="trinary")).cells.tolist() == grid.cells.tolist()


def test_a_negated_map_is_white_occupied(save):
    for word in ("1", "true"):
        assert cells(save(negate=word)) == [[0, 0, -1, -1], [100, 100, 100, 100]]


def test_thresholds_belong_to_what_they_name(save):
    # 102 / 255 is 0.4 and 204 / 255 is 0.8 exactly.
    image = np.array([[101, 102, 103, 203, 204, 205]], np.uint8)
    path = save(image, occupied_thresh=0.6, free_thresh=0.2)
    assert cells(path) == [[100, 100, -1, -1, 0, 0]]


def test_a_scaled_map_spreads_what_lies_between_the_thresholds(save):
    assert cells(save(mode="scale")) == [[100, 100, 89, 40], [0, 0, 0, 0]]


def test_a_raw_map_holds_percentages(save):
    image = np.array([[0, 1, 99, 100, 101, 255]], np.uint8)
    for negate in (0, 1):
        assert cells(save(image, mode="raw", negate=negate)) == [
            [0, 1, 99, 100, -1, -1]
        ]


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_pixels_that_are_not_opaque_are_unknown(save, mode):
    image = np.zeros((1, 4, 4), np.uint8)
    image[0, :, 3] = 255, 254, 0, 255
    image[0, 3, :3] = 255
    assert cells(save(image, "map.png", mode=mode)) == [[100, -1, -1, 0]]


def test_colours_count_by_their_brightness(save):
    image = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [90, 90, 90]]], np.uint8)
    assert cells(save(image, "map.png", mode="raw")) == [[54, -1, 18, 90]]


def test_palettes_and_bilevel_images_are_read(save, tmp_path):
    path = save(None, "map.png")
    for mode in ("P", "1", "L", "RGB", "RGBA", "LA"):
        Image.fromarray(np.array([[0, 255]], np.uint8)).convert(mode).save(
            tmp_path / "map.png"
        )
        assert cells(path) == [[100, 0]], mode


@pytest.mark.parametrize(
    "image",
    [
        b"P5\n# GIMP\n4 2\n# more\n255\n" + GREYS.tobytes(),
        b"P2\n# plain\n4 2\n255\n0 50 100 150\n200 205 254 255\n",
        b"P5 4 2 65535\n" + (GREYS.astype(">u2") * 257).tobytes(),
        b"P2 4 2 65535\n"
        + " ".join(str(v * 257) for v in GREYS.ravel().tolist()).encode(),
    ],
    ids=["binary", "plain", "16 bit", "plain 16 bit"],
)
def test_all_kinds_of_pgm_give_the_same_map(save, image):
    assert cells(save(image, mode="scale")) == [[100, 100, 89, 40], [0, 0, 0, 0]]


@pytest.mark.parametrize("kind", ["I;16", "RGBA", "P"])
def test_no_kind_of_image_takes_many_bytes_for_a_pixel(save, tmp_path, kind):
    """A few kilobytes of PNG hold millions of pixels."""
    side = 2000
    path = save(name="map.png")
    Image.new(kind, (side, side)).save(tmp_path / "map.png")
    tracemalloc.start()
    try:
        assert load_map(path).cells.shape == (side, side)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 10 * side**2 + 2**26, f"{peak / side**2:.1f} bytes for a pixel"


def test_the_shipped_map_is_one_closed_room_with_doors():
    room = load_map("room")
    assert room.cells.shape == (160, 200)
    assert set(np.unique(room.cells)) == {-1, 0, 100}
    rooms, _ = ndimage.label(
        room.free & (room.distance_field > 0.3)
    )  # where a robot may go
    places = [
        tuple(room.world_to_cell(place))
        for place in ([0.0, 0.0], [4.0, -2.5], [5.0, 2.0])
    ]
    assert len({int(rooms[place]) for place in places} | {0}) == 2


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("drop: [negate]", "map.yaml: the key 'negate' is missing; add it"),
        ("resolutoin: 1", "unknown key 'resolutoin'; did you mean 'resolution'?"),
        ("resolution: 0", "'resolution': input should be greater than or equal to 0.0"),
        ("mode: trinery", "'mode': input should be 'trinary', 'scale' or 'raw', not"),
        ("free_thresh: 0.7", "free_thresh must be less than occupied_thresh"),
        (
            "occupied_thresh: 65",
            "'occupied_thresh': input should be less than or equal",
        ),
        ("negate: 2", "key 'negate'"),
    ],
)
def test_a_wrong_key_is_named_with_its_file(save, text, sentence):
    with pytest.raises(ConfigError) as error:
        load_map(save(**yaml.safe_load(text)))
    assert sentence in str(error.value)
    assert "map.yaml" in str(error.value)


def test_a_missing_image_is_named_with_the_nearest(save, tmp_path):
    path = save()
    (tmp_path / "map.pgm").rename(tmp_path / "mop.pgm")
    with pytest.raises(
        ConfigError, match=r"key 'image'.*map\.pgm'; did you mean 'mop\.pgm'\?"
    ):
        load_map(path)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (b"", "is no whole PGM, PNG or BMP image"),
        (b"P5 4 2 255\nabc", "is no whole PGM, PNG or BMP image"),
        (b"P2 2 1 255\n1 cat\n", "is no whole PGM, PNG or BMP image"),
        (b"\x89PNG\r\n\x1a\nxxxxxxxxxxxxxxxx", "is no whole PGM, PNG or BMP image"),
        (b"P5 9000 9000 255\n", "has too many pixels, a map may have 64"),
    ],
)
def test_a_damaged_or_too_large_image_is_one_sentence(save, image, reason):
    with pytest.raises(ConfigError, match=rf"map\.pgm: {reason}"):
        load_map(save(image))
