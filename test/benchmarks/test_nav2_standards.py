from __future__ import annotations

import math

import pytest
from benchmarks.runs import asked

pytestmark = pytest.mark.process


def test_without_obstacles_names_and_controller_each_bar_is_missed():
    code, result = asked("nav2_standards.py", "--control", "bare", "--episodes", "1")
    assert code == 1
    missed = " ".join(result["failures"])
    assert "map_agreement" in missed
    if not math.isnan(result["follow_path_success"] or math.nan):
        assert result["follow_path_success"] == 0.0
