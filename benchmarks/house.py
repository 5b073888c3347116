"""How large is the package, and how hard to find one's way in: figures of its source.

Computed from the syntax trees alone. A module is a file other than `__init__.py`; a single importer
is a module that only one other imports; a circle is a group of modules that import each other.
Arguments of commands are a user's options and do not count. A positional unpack takes an argument
of a compiled function apart by place instead of by name. A docstring that begins with What,
Whether, How, Who, Which or Why asks instead of saying what the thing does.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

from measuring.syntax import figures
from measuring.verdict import answer, parser_of

CONTROLS = {
    "planted": "order: a folder of modules that break every rule is added",
    "crowded": "the limit of modules: 200 small ones are added",
}
PACKAGE = Path(__file__).resolve().parents[1] / "nics_drl_bridge"
BARS = {
    # 180 and 33,000 until it read any recording, knew ten kinds of robots instead of six, and what
    # motors do to every command, judged itself by yardsticks, and named units and clocks that
    # can't be; 194 and 40,000 until it imported worlds of Gazebo, held those of a benchmark, and
    # drew its episodes from sets of worlds; 202 and 41,500 until it grew such sets, and a robot
    # named its lidar and skidded in MuJoCo, training had an engine of its own, and bodies lay in
    # cells; 204 and 42,400 until evaluations had a gate, a lidar and a randomisation, the shield
    # knew the ground where a lidar never looks, trainings the ways around obstacles, policies had
    # a memory, and planners mapped a scan, rolled out a model and were imitated; 217 and 45,200
    # until trainings stopped by themselves, mirrored and began easily, planners stood behind
    # policies, bags became data sets, and nodes told of themselves and ended while they compile;
    # 232 and 46,700 until networks of others drove, and bundles of LEAPP went both ways; 239 and
    # 48,100 until simulators served simulation_interfaces and were driven by it, policies followed
    # Nav2's paths, a page showed episodes, topics and bags, reports concluded, launch files had a
    # module, and robots of one's own inherited trainings.
    "modules": 280,
    "lines": 54_900,
    "single_importers": 71,
    "circles": 0,
    "max_arguments": 10,
    "max_body": 40,
    "duplicate_class_names": 0,
    "positional_unpacks": 0,
    "what_docstrings": 0,
}
PLANTED = {
    "one.py": '''"""What is in here."""
from nics_drl_bridge.planted import two
from nics_drl_bridge.kernels import kernel

class Twice:
    """Twice."""

@kernel
def unpack(a, b, c, d, e, f, g, h, i, j, k):
    x, y, z = a
''',
    "two.py": '''"""Whether it is so."""
from nics_drl_bridge.planted import one

class Twice:
    """Twice."""

def long():
'''
    + "    a = 1\n" * 50,
}


def measure(package: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """Figures by the names of `BARS`, and the places that they come from."""
    found, places = figures(package)
    return {name: found[name] for name in BARS}, places


def spoilt(folder: Path, control: str) -> Path:
    """A copy of the package without what a control takes out."""
    copy = folder / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "planted").mkdir()
    files = PLANTED
    if control == "crowded":
        files = {f"small_{i}.py": '"""A small module."""\n' for i in range(200)}
    for name, text in files.items():
        (copy / "planted" / name).write_text(text)
    return copy


def missed_of(result: dict[str, int]) -> list[str]:
    """A sentence for each bar that is missed."""
    return [
        f"{name}: {result[name]}, bar at most {bar}"
        for name, bar in BARS.items()
        if not result[name] <= bar
    ]


def table_of(result: dict[str, int], places: dict[str, list[str]]) -> str:
    """The figures, and for each that misses its bar the places."""
    text = "".join(f"{name:<24}{result[name]:>8}{bar:>8}\n" for name, bar in BARS.items())
    for name, bar in BARS.items():
        if result[name] > bar and places.get(name):
            text += f"\n{name}:\n" + "".join(f"  {place}\n" for place in places[name])
    return f"{'':<24}{'is':>8}{'bar':>8}\n" + text


def main() -> None:
    """Prints a table, or one JSON object; ends with 1 where a bar was missed."""
    given = parser_of(__doc__, CONTROLS).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        package = spoilt(Path(folder), given.control) if given.control else PACKAGE
        result, places = measure(package)
    kept: dict[str, Any] = dict(result)
    answer(kept, missed_of(result), table_of(result, places), given.json)


if __name__ == "__main__":
    main()
