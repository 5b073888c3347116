"""What the look-up reads, where memory beside its table is forbidden."""

from __future__ import annotations

import subprocess
import sys

import pytest

BETWEEN_FORBIDDEN_PAGES = """
import ctypes, mmap
from dataclasses import replace
import numpy as np
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.scanner import Scanner
from nics_drl_bridge.lidar.shapes import Circle, Rectangle
from nics_drl_bridge.lidar.spec import LidarSpec

spec = LidarSpec(
    beams=48, angle_min=-np.pi, angle_max=np.pi, range_min=0.0, range_max=3.0, rate=10
)
shapes = Circle(radius=0.15), Rectangle(size=(0.6, 0.06))
table = bake(spec, shapes)
rows, page = table.rows, mmap.PAGESIZE
pages = -(-rows.nbytes // page)
room = mmap.mmap(-1, (pages + 2) * page)
begin = ctypes.addressof(ctypes.c_char.from_buffer(room))
for forbidden in (begin, begin + (pages + 1) * page):
    assert not ctypes.CDLL(None).mprotect(ctypes.c_void_p(forbidden), page, 0)
after_first_page = page
before_last_page = (pages + 1) * page - rows.nbytes
for offset in (after_first_page, before_last_page):
    guarded = np.frombuffer(room, np.float32, rows.size, offset)
    guarded[:] = rows
    scanner = Scanner(spec, replace(table, rows=guarded), "baked")
    assert scanner.arguments.table.rows is guarded
    rng = np.random.default_rng(0)
    for shape in shapes:
        distance = shape.radius + rng.uniform(0.0, 1.0, 20_000) ** 3 * 3.0
        angle, heading = rng.uniform(-np.pi, np.pi, (2, 20_000))
        x = distance * np.cos(angle)
        y = distance * np.sin(angle)
        poses = np.stack([x, y, heading], axis=1)
        scanner.scan(np.zeros((20_000, 3)), scanner.place([shape], poses[:, None]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="forbids pages as Linux does")
@pytest.mark.process
def test_a_look_up_reads_nothing_outside_of_its_table():
    command = [sys.executable, "-c", BETWEEN_FORBIDDEN_PAGES]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
