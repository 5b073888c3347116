from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
NEEDS_ROS = "drive_over_dds"
MOST_BYTES = 100_000  # of a picture of the docs
SAYS = {
    "compare_with_planner": r"differential: (8|9|10)\d%",
    "drive_foreign_policy": "success",
    "drive_over_dds": "success over DDS; the estimates differ by 0",
    "evaluate_policy": r"success (9\d|100)",
    "fit_model": r"vx = 0\.\d+\*left_wheel",
    "own_task": r"success after \d+ steps",
    "pass_the_gate": "rule 'command_malformed'",
    "several_robots": "reached: True",
}


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(300)  # a cold start compiles
def test_every_example_runs_in_a_process_of_its_own(example, tmp_path):
    if example.stem == NEEDS_ROS and find_spec("rclpy") is None:
        pytest.skip("needs ROS 2")
    done = subprocess.run(
        [sys.executable, str(example)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert re.search(SAYS.get(example.stem, r"\w"), done.stdout), done.stdout
    assert (tmp_path / f"{example.stem}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_has_a_main_and_stands_in_the_docs_with_its_picture(
    example,
):
    text = example.read_text(encoding="utf-8")
    assert "\ndef main()" in text
    assert example.name in (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
    picture = ROOT / "docs" / "examples" / f"{example.stem}.png"
    assert 0 < picture.stat().st_size < MOST_BYTES


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, nics_drl_bridge",
        "import gymnasium; gymnasium.make('nics_drl_bridge:NicsBridge/Navigation-v0').close()",
        "from nics_drl_bridge import make; import gymnasium; make().close()",
    ],
)
@pytest.mark.process
def test_gymnasium_knows_the_environments(imports):
    code = f"{imports}\nprint('NicsBridge/Navigation-v0' in gymnasium.registry)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "True"
