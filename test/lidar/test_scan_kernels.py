"""What the look-up reads, where memory beside its table is forbidden."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from robots import lidar

from nics_drl_bridge.lidar import baked_kernels, scan_kernels
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.exact_kernels import LidarPose
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle

BETWEEN_FORBIDDEN_PAGES = """
import ctypes, mmap, sys
from dataclasses import replace
import numpy as np
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.lidar.spec import LidarSpec

beams, side = int(sys.argv[1]), sys.argv[2]
spec = LidarSpec(
    beams=beams, angle_min=-np.pi, angle_max=np.pi, range_min=0.0, range_max=3.0, rate=10
)
shapes = Circle(radius=0.15), Rectangle(size=(0.6, 0.06))
table = bake(spec, shapes)
rows, page = table.rows, mmap.PAGESIZE
pages = -(-rows.nbytes // page)
room = mmap.mmap(-1, (pages + 2) * page)
begin = ctypes.addressof(ctypes.c_char.from_buffer(room))
for forbidden in (begin, begin + (pages + 1) * page):
    assert not ctypes.CDLL(None).mprotect(ctypes.c_void_p(forbidden), page, 0)
at = page if side == "before" else (pages + 1) * page - rows.nbytes
guarded = np.frombuffer(room, np.float32, rows.size, at)
guarded[:] = rows
scanner = Scanner(spec, replace(table, rows=guarded), "baked")
assert scanner.arguments.table.rows is guarded
rng = np.random.default_rng(0)
for shape in shapes:
    away = shape.radius + rng.uniform(0.0, 1.0, 20_000) ** 3 * 3.0
    angle, heading = rng.uniform(-np.pi, np.pi, (2, 20_000))
    poses = np.stack([away * np.cos(angle), away * np.sin(angle), heading], axis=1)
    scanner.scan(np.zeros((20_000, 3)), scanner.place([shape], poses[:, None]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forbids pages as Linux does")
@pytest.mark.process
@pytest.mark.parametrize("side", ["before", "behind"])
@pytest.mark.parametrize(
    "beams",
    [48, *(pytest.param(n, marks=pytest.mark.campaign) for n in (36, 180, 360, 720))],
)
def test_a_look_up_reads_nothing_outside_of_its_table(beams, side):
    command = [sys.executable, "-c", BETWEEN_FORBIDDEN_PAGES, str(beams), side]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr


def looked_up(view: float, ahead: float, bearing: float) -> bool:
    """True if a disc 1 m away of a lidar that looks `ahead`, as wide as `view`, gets a lane."""
    spec = lidar(beams=91, angle_min=ahead - view / 2.0, angle_max=ahead + view / 2.0)
    disc = Circle(radius=0.2)
    scanner = Scanner(spec, bake(spec, [disc]), "baked")
    turned = bearing + 0.7  # as the lidar is
    body = scanner.place([disc], [[np.cos(turned), np.sin(turned), 0.0]])
    here = LidarPose(0.0, 0.0, np.cos(0.7), np.sin(0.7))
    lanes = scan_kernels.scan_lanes()
    near = np.zeros(1, int)
    found, computed = scan_kernels.select_bodies(
        body, near, -1, here, 0.7, 0, scanner.arguments, lanes, 0
    )
    assert computed == 0
    return bool(found)


@pytest.mark.parametrize("ahead", [0.0, 2.5])
@pytest.mark.parametrize("view", [0.5, np.pi, 1.5 * np.pi, 1.9 * np.pi])
def test_of_bodies_only_those_wholly_behind_all_beams_are_not_looked_up(view, ahead):
    half = np.arcsin(0.2)  # of the angle at which the disc is seen
    edge = view / 2.0 + half
    assert looked_up(view, ahead, ahead)
    assert looked_up(view, ahead, ahead + edge - 0.01)
    assert looked_up(view, ahead, ahead - edge + 0.01)
    behind = (
        np.pi - edge > view / 90.0
    )  # the disc fits between the last beam and the first
    assert looked_up(view, ahead, ahead + np.pi) != behind


def test_a_body_behind_all_beams_is_not_scanned_exactly_either():
    spec = lidar(beams=91, angle_min=-1.0, angle_max=1.0)
    disc = Circle(radius=0.2)
    scanner = Scanner(spec, bake(spec, [disc]), "exact")
    body = scanner.place([disc], [[1.0, 0.0, 0.0]])
    sensor = scanner.arguments
    scratch = scan_kernels.scan_lanes().walls
    near = np.zeros(1, np.int32)

    def hits(sensor):
        scan = np.full(91, np.inf, np.float32)
        here = LidarPose(0.0, 0.0, 1.0, 0.0)
        walls = np.zeros((0, 4))
        baked_kernels.scan_exactly(scan, here, body, near, -1, walls, sensor, scratch)
        return int(np.isfinite(scan).sum())

    # The same beams, of which the kernels believe that they all point backwards.
    turned = sensor.beams._replace(behind=-sensor.beams.behind)
    assert hits(sensor) > 10
    assert hits(sensor._replace(beams=turned)) == 0
