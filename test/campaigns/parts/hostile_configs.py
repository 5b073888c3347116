"""Configurations that an attacker would write: YAML that grows, and values that nobody means."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from parts.attempt import Attempt, nics

from nics_drl_bridge.config import dump_yaml, parse_yaml, share_folder
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.recording.topic_roles import load_topic_roles
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.scenes import sample_scene
from nics_drl_bridge.sim.world import load_world

Rng = np.random.Generator


def _world(path: str) -> object:
    return sample_scene(load_world(path), 0.2, 0)


def _lidar(path: str) -> object:
    shapes = [Circle(radius=0.2)]
    scanner = make_scanner(load_lidar(path), shapes, renderer="exact")
    return scanner.scan([0.0, 0.0, 0.0], scanner.place(shapes, [[1.0, 0.5, 0.0]]))


def _map(path: str) -> object:
    return load_map(path).arrays


USES: dict[str, Callable[[str], object]] = {
    "robots/ackermann": load_robot,
    "robots/differential": load_robot,
    "lidars/rplidar_a2": _lidar,
    "lidars/paper": _lidar,
    "worlds/arena": _world,
    "worlds/doorway": _world,
    "worlds/crowd": _world,
    "worlds/clutter": _world,
    "limits/differential": lambda path: load_limits(path, load_robot("differential")),
    "randomisation/strong": load_randomisation,
    "training/navigation_differential": load_training,
    "maps/room": _map,
    "topics": load_topic_roles,
}
"""What is done with the file of each kind."""
OWN = {
    "topics": "cmd_vel: /cmd_vel\nodom: /odom\nstamps: header\n",
}


def attempts(rng: Rng, folder: Path) -> Iterator[Attempt]:
    """Without end: YAML that is none or grows, hostile values in true files, huge worlds."""
    shutil.copy(share_folder() / "config" / "maps" / "room.pgm", folder)
    shutil.copy(share_folder() / "config" / "maps" / "room.yaml", folder)
    kinds = list(USES)
    while True:
        kind = kinds[int(rng.integers(len(kinds)))]
        path = folder / "hostile.yaml"
        draw = rng.random()
        use = USES[kind]
        text = _text_of(kind)
        if draw < 0.08:
            path.write_text(text, encoding="utf-8")
            yield Attempt("yaml", f"{kind} as shipped", _used(use, path), "good")
        elif draw < 0.4:
            told, bad = _syntax(rng, text)
            path.write_text(bad, encoding="utf-8")
            yield Attempt("yaml", f"{kind}: {told}", _used(use, path))
        elif draw < 0.6:
            told, bad = _WORLDS[int(rng.integers(len(_WORLDS)))](rng)
            path.write_text(bad, encoding="utf-8")
            act = nics(
                "train", "--world", path, "--steps", "1", "--out", folder / "run"
            )
            use = _used(_world, path) if rng.random() < 0.7 else act
            fits = (
                told != "more than fit" or use is not act
            )  # which nobody finds by baking
            yield Attempt("world", told, use, "bad" if fits else "any")
        elif draw < 0.7:
            yield _picture(rng, folder)
        else:
            told, bad = _replaced(rng, text)
            path.write_text(bad, encoding="utf-8")
            yield Attempt("values", f"{kind}: {told}", _used(use, path), "any")


def _used(use: Callable[[str], object], path: Path) -> Callable[[], object]:
    return lambda: use(str(path))


def _text_of(kind: str) -> str:
    path = share_folder() / "config" / f"{kind}.yaml"
    return OWN[kind] if kind in OWN else path.read_text(encoding="utf-8")


def _syntax(rng: Rng, text: str) -> tuple[str, str]:
    """YAML that is never read, put behind a true file."""
    n = int(rng.integers(4, 30))
    times = int(rng.integers(2, 12))
    base = "k0: &k0 {x: 1, y: 2}\n"
    value = str(rng.choice(["[1]", '"%%"', "abc", "{a: 1}", '""']))
    merged = "".join(
        f"k{i}: &k{i} {{<<: [{_again(i, times)}]}}\n" for i in range(1, 3 * n)
    )
    listed = "".join(f"k{i}: &k{i} [{_again(i, times)}]\n" for i in range(1, 3 * n))
    tag = rng.choice(
        [
            "int",
            "float",
            "bool",
            "timestamp",
            "set",
            "omap",
            "pairs",
            "binary",
            "map",
            "python/object/apply:os.system",
            "python/tuple",
            "value",
            "str",
        ]
    )
    endless = "9" * int(rng.integers(5_000, 300_000))
    choices = {
        "merge keys": base + merged,
        "aliases": base + listed,
        "tag": f"tagged: !!{tag} {value}\n",
        "tag of a key": f"!!{tag} k: {value}\n",
        "digits": f"digits: {endless}\n",
        "deep list": f"deep: {'[' * (n * 20)}{']' * (n * 20)}\n",
        "deep mapping": f"deep: {'{a: ' * (n * 20)}1{'}' * (n * 20)}\n",
        "values": f"many: [{'1,' * (20_000 * times)}1]\n",
        "long key": f"{'k' * (1000 * n)}: 1\n",
        "large": f"large: {'x' * (100_000 * n + 900_000)}\n",
        "itself": "a: &a {<<: *a}\n",
        "key twice": f"{'t' * 300}: 1\n{'t' * 300}: 2\n",
        "lines in a key": '"a\\nb\\nc\\u001b[2J": 1\n',
        "unclosed": f"{'a: [' * times}",
        "bytes": "\x00\x01",
    }
    told = str(rng.choice(list(choices)))
    return (
        f"{told} {n} {times} {tag if 'tag' in told else ''}",
        text.rstrip() + "\n" + choices[told],
    )


def _again(i: int, times: int) -> str:
    return ", ".join([f"*k{i - 1}"] * times)


def _with(**changes: Any) -> str:
    world = {"name": "w", "size": [6.0, 6.0], "goal_distance": [1.0, 4.0]}
    return dump_yaml(world | changes)


def _group(**keys: Any) -> list[dict[str, Any]]:
    return [{"shapes": [{"kind": "circle", "radius": 0.1}], **keys}]


def _big(rng: Rng) -> float:
    return float(10.0 ** rng.uniform(7, 307))


_WORLDS: tuple[Callable[[Rng], tuple[str, str]], ...] = (
    lambda rng: (
        "copies",
        _with(obstacles=_group(count=int(10 ** rng.uniform(5, 18)))),
    ),
    lambda rng: (
        "copies, a range",
        _with(obstacles=_group(count=[0, int(10 ** rng.uniform(5, 18))])),
    ),
    lambda rng: (
        "many groups",
        _with(obstacles=_group(count=9000) * int(rng.integers(2, 40))),
    ),
    lambda rng: ("a huge field", _with(size=[_big(rng), _big(rng)])),
    lambda rng: ("a long field", _with(size=[_big(rng), 1e-3])),
    lambda rng: ("a tiny field", _with(size=[10.0 ** rng.uniform(-320, -5)] * 2)),
    lambda rng: (
        "a huge shape",
        _with(
            obstacles=[
                {"shapes": [{"kind": "circle", "radius": _big(rng)}], "count": 3}
            ]
        ),
    ),
    lambda rng: (
        "a tiny shape",
        _with(
            obstacles=[
                {
                    "shapes": [
                        {
                            "kind": "rectangle",
                            "size": [10.0 ** rng.uniform(-322, -100)] * 2,
                        }
                    ],
                    "count": 3,
                }
            ]
        ),
    ),
    lambda rng: ("many walls", _with(walls=[[0, 0, 1, k] for k in range(30_000)])),
    lambda rng: (
        "a wall to the stars",
        _with(walls=[[0.0, 0.0, _big(rng), _big(rng)]]),
    ),
    lambda rng: (
        "a polygon",
        _with(
            obstacles=[
                {
                    "count": 1,
                    "shapes": [
                        {
                            "kind": "polygon",
                            "points": rng.normal(size=(20_000, 2)).round(2).tolist(),
                        }
                    ],
                }
            ]
        ),
    ),
    lambda rng: ("a gap", _with(obstacles=_group(count=5, gap=_big(rng)))),
    lambda rng: ("a far goal", _with(goal_distance=[1.0, -_big(rng)])),
    lambda rng: ("a clearance", _with(clearance=_big(rng))),
    lambda rng: ("more than fit", _with(obstacles=_group(count=9999, gap=0.5))),
    lambda rng: ("places beyond", _with(starts={"regions": [[_big(rng)] * 4]})),
)


def _picture(rng: Rng, folder: Path) -> Attempt:
    """A map whose image is no image, or one of more pixels than any map."""
    image = folder / "image.pgm"
    image.unlink(missing_ok=True)
    big = int(rng.integers(9_000, 2**31))
    way = str(
        rng.choice(
            ["a pipe", "/dev/zero", "a loop", "pixels", "a folder", "PNG", "noise"]
        )
    )
    if way == "a pipe":
        os.mkfifo(image)
    elif way == "/dev/zero":
        image.symlink_to(way)
    elif way == "a loop":
        image.symlink_to(image)
    elif way == "a folder":
        image = folder
    elif way == "pixels":
        image.write_bytes(b"P5\n%d %d\n255\n" % (big, big) + bytes(1000))
    elif way == "PNG":
        size = big.to_bytes(4, "big") * 2
        image.write_bytes(
            b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + size + b"\x08\0\0\0\0" + bytes(50)
        )
    else:
        image.write_bytes(rng.integers(256, size=5000, dtype=np.uint8).tobytes())
    text = (folder / "room.yaml").read_text(encoding="utf-8")
    path = folder / "map.yaml"
    path.write_text(text.replace("room.pgm", str(image)), encoding="utf-8")
    return Attempt("map", f"image is {way} {big}", _used(_map, path))


_VALUES: tuple[Any, ...] = (
    "word",
    -1,
    0,
    1e308,
    1e-320,
    10**18,
    2**63,
    10**30,
    -(2**63),
    float("nan"),
    float("inf"),
    None,
    True,
    [],
    {},
    [[[1]]],
    "x" * 5000,
    [1.0] * 5000,
    "a\nb\x1b[2J",
    1e9,
    1e12,
    10**9,
    {"a": {"b": 1}},
)


def _replaced(rng: Rng, text: str) -> tuple[str, str]:
    """A true file with something else in the place of one of its values, or of several."""
    data: Any = parse_yaml(text, "shipped")
    told = []
    for _ in range(int(rng.integers(1, 3))):
        inner = data
        place = []
        while True:
            keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
            key = keys[int(rng.integers(len(keys)))]
            place.append(str(key))
            if (
                not isinstance(inner[key], dict | list)
                or not inner[key]
                or rng.random() < 0.2
            ):
                break
            inner = inner[key]
        which = int(rng.integers(len(_VALUES)))
        inner[key] = _VALUES[which]
        told.append(f"{'.'.join(place)} is {str(_VALUES[which])[:30]!r}")
    return "; ".join(told), dump_yaml(data)
