from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "env_scaling.py"
CURVES = {"worlds": 16384, "robots": 64, "obstacles": 256, "beams": 2048}


@pytest.mark.timeout(300)  # a cold start compiles
def test_the_curves_are_lists_under_their_names_and_are_drawn(tmp_path):
    picture = tmp_path / "scaling.png"
    few = ("--ends-only", "--repeats", "5", "--picture", str(picture))
    command = [sys.executable, str(SCRIPT), *few, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    for name, greatest in CURVES.items():
        assert found[name][-1] == greatest
        assert len(found[f"{name}_us"]) == len(found[name]) == 2
        assert min(found[f"{name}_us"]) > 0.0
    assert picture.stat().st_size > 1000
