"""Imports run one way, each library has one home, and importing the package costs nothing."""

import ast
import subprocess
import sys
from fnmatch import fnmatch
from importlib.util import find_spec
from pathlib import Path

import pytest

from nics_drl_bridge import kernels

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "nics_drl_bridge"

# From the bottom up. What stands on one line does not import each other.
LAYERS = (
    ("defaults", "exit_codes", "status"),
    ("errors", "geometry", "interface"),
    ("kernels",),
    ("arguments", "extensions", "random_kernels", "seeds"),
    ("confidence", "config", "files", "pacing", "style", "threads"),
    ("robot",),
    ("recording",),
    ("identify",),
    ("lidar",),
    ("generator",),
    ("sim",),
    ("middleware",),
    ("env",),
    ("policy",),
    ("gate",),
    ("report",),
    ("watch",),
    ("nodes",),
    ("commands",),
    ("extras",),
)
ORDER = "".join(
    f"    {'  ' if level else ''}{'< ' if level else ''}{', '.join(parts)}\n"
    for level, parts in enumerate(LAYERS)
)

# Library -> where it may be imported; * of a message package stands for any name.
HOMES = {
    "rclpy": ("nodes/*", "extras/*"),
    "*_msgs": ("nodes/*", "extras/*"),
    "std_srvs": ("nodes/*", "extras/*"),
    "builtin_interfaces": ("nodes/*", "extras/*"),
    "ament_index_python": ("nodes/*", "extras/*"),
    "filterpy": ("middleware/ekf.py",),
    "matplotlib": ("report/*", "env/rendering.py", "style.py"),
    "yaml": ("config.py",),
    "typer": ("commands/*", "extras/*"),
    "gymnasium": ("env/*", "policy/*", "watch/*", "commands/*", "extras/*"),
    "numba": ("*kernels.py",),
    "PIL": ("lidar/maps.py", "watch/record.py"),
    "llvmlite": ("*kernels.py",),
    "mujoco": ("extras/mujoco/*",),
    "dartpy": ("extras/dart/*",),
    "tensorboard": ("policy/train/*",),
    "torch": ("extras/ray/*", "extras/sb3/*"),
    "stable_baselines3": ("policy/train/*", "extras/sb3/*"),
    "onnx": ("policy/*", "extras/foreign_policies/*", "extras/sb3/*"),
    "onnxruntime": ("policy/*",),
    "safetensors": ("extras/foreign_policies/*",),
    "pettingzoo": ("env/pettingzoo_env.py",),
    "ray": ("extras/ray/*",),
    "rosbags": ("recording/*", "extras/bags/*"),
    "pyarrow": ("recording/*",),
    "mcap": ("recording/*", "extras/bags/*"),
    "threadpoolctl": ("threads.py",),
    "websockets": ("watch/server.py",),
    "imageio_ffmpeg": ("watch/record.py",),
}


def imports_of(path: Path, package: Path) -> set[str]:
    """Every module that a file imports, at its top or inside a function, by its full name."""
    found = set()
    here = (package.name, *path.relative_to(package).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = ".".join(here[: len(here) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (above, node.module) if part)
            found |= {f"{module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and "import_module" in (
            getattr(node.func, "id", ""),
            getattr(node.func, "attr", ""),
        ):
            found |= {a.value for a in node.args if isinstance(a, ast.Constant)}
    return found


def layer_of(part: str) -> int | None:
    return next((level for level, parts in enumerate(LAYERS) if part in parts), None)


Imports = dict[Path, set[str]]


def read_imports(package: Path) -> Imports:
    """What each file of a package imports; paths begin with the package's name."""
    return {
        path.relative_to(package.parent): imports_of(path, package)
        for path in sorted(package.rglob("*.py"))
    }


def wrong_directions(imports: Imports) -> list[str]:
    """A sentence for each import that runs up or sideways."""
    wrong = []
    for path, modules in imports.items():
        place = Path(*path.parts[1:])
        own = place.parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        if layer_of(own) is None:
            wrong.append(f"{place}: {own!r} stands in no layer")
            continue
        for module in sorted(modules):
            first, _, rest = module.partition(".")
            part = rest.partition(".")[0]
            if first != PACKAGE or part == own or layer_of(part) is None:
                continue
            if layer_of(part) >= layer_of(own):
                wrong.append(f"{place}: imports {module}")
    return wrong


def strangers(imports: Imports) -> list[str]:
    """A sentence for each library that is imported away from its home."""
    wrong = []
    for path, modules in imports.items():
        place = Path(*path.parts[1:]).as_posix()
        for library in sorted({module.partition(".")[0] for module in modules}):
            for name, homes in HOMES.items():
                away = not any(fnmatch(place, home) for home in homes)
                if fnmatch(library, name) and away:
                    wrong.append(f"{place}: imports {library}")
    return wrong


def test_the_page_on_architecture_shows_the_order():
    assert ORDER in (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_imports_run_one_way_and_each_library_is_imported_at_its_home_only():
    imports = read_imports(ROOT / PACKAGE)
    assert wrong_directions(imports) + strangers(imports) == []


ENV = f"""
from {PACKAGE}.env.bridge_env import BridgeEnv
env = BridgeEnv(backend="sim")
env.reset(seed=0)
env.step(env.action_space.sample())
env.close()
"""
SLOW = "numba scipy matplotlib gymnasium torch rclpy"
ROS = pytest.mark.ros(
    pytest.mark.skipif(find_spec("rclpy") is None, reason="needs ROS 2")
)


@pytest.mark.process
@pytest.mark.timeout(300)  # without numba's caches, all kernels are compiled here
@pytest.mark.parametrize(
    ("code", "needed", "heavy"),
    [
        (f"import {PACKAGE}", PACKAGE, f"{SLOW} numpy pydantic filterpy"),
        (f"import {PACKAGE}.commands.cli", "typer", f"{SLOW} numpy onnx"),
        pytest.param(
            f"import {PACKAGE}.nodes.command_gate",
            "rclpy",
            "gymnasium matplotlib onnx onnxruntime scipy.linalg scipy.ndimage scipy.stats "
            "stable_baselines3 torch",
            marks=ROS,
        ),
        pytest.param(
            ENV,
            "numba",
            "dartpy geometry_msgs matplotlib mujoco rclpy scipy.signal sensor_msgs typer",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["package", "help", "gate", "env"],
)
def test_what_starts_loads_nothing_that_it_does_not_need(code, needed, heavy):
    ask = f"import sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", ask], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert needed in loaded
    assert not loaded & set(heavy.split())


LIGHT = {
    "config.py",
    "errors.py",
    "geometry.py",
    "interface.py",
    "lidar/arrays.py",
    "robot/curve.py",
    "robot/taylor.py",
    "sim/state.py",
    "status.py",
    "strict_yaml.py",
}


def test_kernels_import_kernels_only_so_that_no_other_edit_compiles_them_anew():
    heavy = {}
    for path in (ROOT / PACKAGE).rglob("*.py"):
        if "@kernel" not in path.read_text(encoding="utf-8") or path == Path(
            kernels.__file__
        ):
            continue
        assert path.name.endswith("kernels.py"), path
        files = set()
        left = [path]
        while left:
            file = left.pop()
            if file not in files:
                files.add(file)
                left += kernels.imports_of(file)
        others = {
            file.relative_to(kernels.PACKAGE).as_posix() for file in files
        } - LIGHT
        heavy[str(path)] = {name for name in others if not name.endswith("kernels.py")}
    assert {name: found for name, found in heavy.items() if found} == {}


@pytest.mark.parametrize(
    ("find", "file", "line"),
    [
        (wrong_directions, "robot/taylor.py", "from ..env import navigation"),
        (wrong_directions, "sim/world.py", "import_module('nics_drl_bridge.nodes.x')"),
        (wrong_directions, "nowhere/new.py", ""),
        (strangers, "env/task.py", "def f():\n    from geometry_msgs.msg import Twist"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, find, file, line):
    path = tmp_path / PACKAGE / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    (sentence,) = find(read_imports(tmp_path / PACKAGE))
    assert sentence.startswith(f"{file}: ")
