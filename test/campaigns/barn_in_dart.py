"""Whether DART reads the worlds of the benchmark BARN as this package does.

Gazebo's parser of worlds comes with DART, which also casts the rays. Each of the 250 public worlds
is scanned from some free poses, as DART reads it and as this package reads it. Where a world's own
`.world` file is at hand, both read that; the other files are written from the coordinates that the
package ships.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from campaign import ROOT, Given, Result, at_least, at_most, run_campaign, tell
from dart_worlds import Comparison, compare_readings

from nics_drl_bridge.sim import barn

PUBLISHED = ROOT.parent / "shared" / "barn" / "gazebo"
AT_ONCE = 2
MOVED = (0.05, 0.0, 0.0)  # [m]
LENGTH = 1.0  # of the cylinders [m]
CYLINDER = """
    <model name="cylinder_{k}">
      <static>1</static>
      <pose>{x:.6f} {y:.6f} 0 0 0 0</pose>
      <link name="link">
        <inertial>
          <mass>1</mass>
          <inertia><ixx>0.1</ixx><iyy>0.1</iyy><izz>0.1</izz>
            <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>
        </inertial>
        <collision name="collision">
          <geometry>
            <cylinder><radius>{radius}</radius><length>{length}</length></cylinder>
          </geometry>
        </collision>
      </link>
    </model>"""


@dataclass(frozen=True)
class Job:
    """A world to be read twice."""

    number: int
    folder: Path
    poses: int
    is_moved: bool


def write_world(number: int) -> str:
    """Returns a world of BARN as SDF."""
    (group,) = barn.barn_world(number).obstacles
    sizes = {"radius": barn.RADIUS, "length": LENGTH}
    models = (
        CYLINDER.format(k=k, x=x, y=y, **sizes) for k, (x, y, _) in enumerate(group.at)
    )
    name = f"barn_{number}"
    return f'<sdf version="1.6"><world name="{name}">{"".join(models)}</world></sdf>\n'


def read_twice(job: Job) -> Comparison:
    """Compares the readings of a world, from its published file if there is one."""
    path = PUBLISHED / f"world_{job.number}.world"
    if not path.is_file():
        path = job.folder / f"world_{job.number}.world"
        path.write_text(write_world(job.number), encoding="utf-8")
    moved = MOVED if job.is_moved else (0.0, 0.0, 0.0)
    return compare_readings(path, job.number, job.poses, moved)


def measure(given: Given) -> Result:
    """Reads and scans the worlds."""
    numbers = barn.barn_numbers()[:: given.every]
    with tempfile.TemporaryDirectory() as folder:
        jobs = [
            Job(number, Path(folder), given.poses, given.control == "moved")
            for number in numbers
        ]
        read = dict(zip(numbers, read_all(jobs), strict=True))
    least = min(read, key=lambda number: read[number].same / read[number].beams)
    beams = sum(each.beams for each in read.values())
    published = sum((PUBLISHED / f"world_{n}.world").is_file() for n in numbers)
    return {
        "worlds": len(read),
        "of_published_files": published,
        "beams": beams,
        "beams_that_hit": sum(each.hits for each in read.values()) / beams,
        "same_beams": sum(each.same for each in read.values()) / beams,
        "worst_world": least,
        "same_beams_there": read[least].same / read[least].beams,
        "other_solids": sum(each.solids != each.by_dart for each in read.values()),
    }


def print_to_stderr() -> None:
    """Sends what DART prints about a file to the standard error of this process."""
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())


def read_all(jobs: list[Job]) -> Iterator[Comparison]:
    """Yields the comparisons of all jobs, in their order."""
    pool = ProcessPoolExecutor(
        AT_ONCE, mp_context=get_context("spawn"), initializer=print_to_stderr
    )
    with pool:
        for job, compared in zip(jobs, pool.map(read_twice, jobs), strict=True):
            tell(f"world {job.number}: {compared}")
            yield compared


BARS = {
    "same_beams": at_least(0.999, "beams within 1 cm"),
    "beams_that_hit": at_least(0.3, "beams that meet something"),
    "other_solids": at_most(0, "worlds of which DART reads more or fewer solids"),
}
OPTIONS = {
    "every": (1, "of so many worlds one"),
    "poses": (8, "of the lidar in each world"),
}

if __name__ == "__main__":
    run_campaign(measure, BARS, OPTIONS)
