from __future__ import annotations

from pathlib import Path

import pytest

from .runs import BENCHMARKS, controls_of

SCRIPTS = sorted(path.name for path in BENCHMARKS.glob("*.py"))
TESTS = "\n".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_benchmark_has_a_control_that_a_test_sees_fail(script):
    controls = controls_of(script)
    assert controls
    assert script in TESTS
    for control in controls:
        assert f'"{control}"' in TESTS
