"""Small inputs that would take much memory or time, or run code, if they were believed."""

from __future__ import annotations

import io
import itertools
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.files import seal, write_sums
from nics_drl_bridge.lidar.table import ARRAYS

Bomb = Callable[[Path, int], None]
"""Puts a bomb of some size, from 1 to 8, in the place of a whole input."""
Open = Callable[[Path], Any]
Save = Callable[[Path, Any], None]
CODE = b"cos\nsystem\n(S'true'\ntR."


# Arrays whose headers promise more than there is.


def _npy(kind: str, shape: str, data: bytes = b"") -> bytes:
    head = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + data


HEADERS: dict[str, Callable[[int], bytes]] = {
    "rows": lambda size: _npy("'<f8'", f"({10 ** (6 + 2 * size)},)"),
    "columns": lambda size: _npy("'<f4'", f"({2**32}, {2**32 + size})"),
    "pickled code": lambda size: _npy("'|O'", "(3,)", CODE),
    "zeros": lambda size: _npy("'<f8'", f"({120_000_000 + size},)", bytes(960_000_000)),
}


def _replace_array(make: Callable[[int], bytes]) -> Bomb:
    """Replaces an array of a recording, whose checksum fits."""

    def write(path: Path, size: int) -> None:
        with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as whole:
            parts = {name: whole.read(name) for name in whole.namelist()}
        name = sorted(parts)[size % len(parts)]
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for each, data in parts.items():
                archive.writestr(each, make(size) if each == name else data)
        path.write_bytes(seal(buffer.getvalue()))

    return write


def _replace_file(make: Callable[[int], bytes]) -> Bomb:
    """Replaces an array of a table, whose checksums fit."""

    def write(path: Path, size: int) -> None:
        (path / f"{ARRAYS[size % len(ARRAYS)]}.npy").write_bytes(make(size))
        write_sums(path)

    return write


RECORDINGS = {name: _replace_array(make) for name, make in HEADERS.items()}
TABLES = {
    name: _replace_file(make) for name, make in HEADERS.items() if name != "zeros"
}


# Lines of CSV, JSON and pickles.


def _write_digits(path: Path, size: int) -> None:
    file = path / ("cmd.csv", "vrpn.csv")[size % 2]
    file.write_text("1" * (7_000_000 * size), encoding="utf-8")


CSVS = {"digits": _write_digits}


def grow_boxes(open_box: Open, save_box: Save) -> Mapping[str, Bomb]:
    """Returns bombs of black boxes, by name."""

    def replace_scan(path: Path, size: int) -> None:
        lines = open_box(path)
        shape = [10 ** (4 + 2 * size)]
        array = {"kind": "array", "type": "<f8", "shape": shape, "data": ""}
        lines[1]["given"] = {"kind": "Scan", "ranges": array}
        save_box(path, lines)

    return {"numbers": replace_scan}


def grow_checkpoints() -> Mapping[str, Bomb]:
    """Returns bombs of checkpoints, by name."""

    def save(make: Callable[[Any], object]) -> Bomb:
        def write(path: Path, size: int) -> None:
            import torch

            buffer = io.BytesIO()
            torch.save(make(torch), buffer)
            path.write_bytes(seal(buffer.getvalue()))

        return write

    return {
        "code": save(lambda torch: {"format": Path("x"), "about": print}),
        "numbers": save(lambda torch: torch.zeros(1).expand(2**40)),
    }


# Networks in front of the true one.


def _chain(length: int, make: Callable[[str, str], Any]) -> list[Any]:
    names = ["observation", *(f"x_{k}" for k in range(length))]
    return [make(a, b) for a, b in itertools.pairwise(names)]


def _node(kind: str, inputs: list[str], output: str, **settings: Any) -> Any:
    return onnx.helper.make_node(kind, inputs, [output], **settings)


def _fill(kind: str, **settings: Any) -> Callable[[int], Any]:
    def make(size: int) -> tuple[list[Any], dict[str, Any]]:
        sizes = np.array([10**4 * size, 10**5], np.int64)
        return [_node(kind, ["x_sizes"], "x_0", **settings)], {"sizes": sizes}

    return make


GRAPHS: dict[str, Callable[[int], tuple[list[Any], dict[str, Any]]]] = {
    "doubled": lambda size: (
        _chain(16 + size, lambda a, b: _node("Concat", [a, a], b, axis=size % 2)),
        {},
    ),
    "operators": lambda size: (
        _chain(1000 + 3000 * size, lambda a, b: _node("Tanh", [a], b)),
        {},
    ),
    "gathered": lambda size: (
        _chain(3, lambda a, b: _node("Gather", [a, "x_index"], b, axis=1)),
        {"index": np.zeros(400_000 * size, np.int64)},
    ),
    "ConstantOfShape": _fill("ConstantOfShape"),
}


def grow_policies(open_contract: Open, save_contract: Save) -> Mapping[str, Bomb]:
    """Returns bombs of policies whose checksums fit, by name."""

    def put_before(make: Callable[[int], tuple[list[Any], dict[str, Any]]]) -> Bomb:
        def write(path: Path, size: int) -> None:
            proto = onnx.load(path)
            data = open_contract(path)
            nodes, arrays = make(size)
            own = list(proto.graph.node)
            del proto.graph.node[:]
            proto.graph.node.extend([*nodes, *own])
            proto.graph.initializer.extend(
                onnx.numpy_helper.from_array(value, f"x_{name}")
                for name, value in arrays.items()
            )
            path.write_bytes(proto.SerializeToString())
            save_contract(path, data)

        return write

    def replace_bytes(make: Callable[[int], bytes]) -> Bomb:
        return lambda path, size: path.write_bytes(make(size)) and None

    def nest(size: int) -> bytes:
        nested = b""
        for _ in range(300 * size):
            nested = _field(1, _field(5, _field(6, nested)))
        return _field(7, nested)

    return {
        **{name: put_before(make) for name, make in GRAPHS.items()},
        "empty operators": replace_bytes(
            lambda size: _field(7, _field(1, b"") * (800_000 * size))
        ),
        "nested graphs": replace_bytes(nest),
    }


def _field(number: int, content: bytes) -> bytes:
    """A field of a message of protocol buffers."""
    size = len(content)
    length = b""
    while size >= 0x80:
        length = length + bytes([size & 0x7F | 0x80])
        size = size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + content


# Worlds and maps.


def _group(**keys: Any) -> list[dict[str, Any]]:
    return [{"shapes": [{"kind": "circle", "radius": 0.1}], "count": 3, **keys}]


def _shape(kind: str, **keys: Any) -> list[dict[str, Any]]:
    return _group(shapes=[{"kind": kind, **keys}])


def _large(size: int) -> float:
    return 10.0 ** (7 + 37 * size)


def _world(make: Callable[[int], dict[str, Any]]) -> Bomb:
    def write(path: Path, size: int) -> None:
        world = {"name": "w", "size": [6.0, 6.0], "goal_distance": [1.0, 4.0]}
        path.write_text(dump_yaml(world | make(size)), encoding="utf-8")

    return write


WORLDS = {
    "copies": _world(lambda n: {"obstacles": _group(count=10 ** (4 + n))}),
    "a range of copies": _world(lambda n: {"obstacles": _group(count=[0, 10**12])}),
    "groups": _world(lambda n: {"obstacles": _group(count=9000) * (5 * n)}),
    "a huge field": _world(lambda n: {"size": [_large(n), _large(n)]}),
    "a tiny shape": _world(
        lambda n: {"obstacles": _shape("rectangle", size=[10.0 ** (-40 * n)] * 2)}
    ),
    "walls": _world(lambda n: {"walls": [[0, 0, 1, k] for k in range(30_000)]}),
}


def _picture(make: Callable[[Path, int], object]) -> Bomb:
    """Replaces the picture of a map."""

    def write(path: Path, size: int) -> None:
        image = path.parent / "room.pgm"
        image.unlink()
        make(image, size)

    return write


MAPS = {
    "a pipe": _picture(lambda image, size: os.mkfifo(image)),
    "an endless device": _picture(lambda image, size: image.symlink_to("/dev/zero")),
    "pixels": _picture(
        lambda image, size: image.write_bytes(
            b"P5\n%d %d\n255\n" % (9000 * size, 2**31) + bytes(1000)
        )
    ),
}
