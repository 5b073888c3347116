from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(300)  # a cold start compiles
def test_every_example_runs_in_a_process_of_its_own(example, tmp_path):
    done = subprocess.run(
        [sys.executable, str(example)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, nics_drl_bridge",
        pytest.param(
            "import gymnasium; gymnasium.make('nics_drl_bridge:NicsBridge/Navigation-v0').close()",
            marks=(pytest.mark.slow, pytest.mark.campaign),
        ),
        pytest.param(
            "from nics_drl_bridge import make; import gymnasium; make().close()",
            marks=pytest.mark.campaign,
        ),
    ],
)
@pytest.mark.process
def test_gymnasium_knows_the_environments(imports):
    code = f"{imports}\nprint('NicsBridge/Navigation-v0' in gymnasium.registry)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
