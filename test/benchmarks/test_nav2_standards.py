from __future__ import annotations

import pytest

from .runs import asked

pytestmark = pytest.mark.process


def test_without_obstacles_nodes_and_a_known_controller_the_bars_are_missed():
    code, result = asked("nav2_standards.py", "--control", "bare", "--episodes", "1")
    assert code == 1
    missed = " ".join(result["failures"])
    assert "map_agreement" in missed
    for name, bad in (("follow_path_success", lambda v: v == 0.0), ("nav2_names_missing", bool)):
        if result[name] is not None:  # its messages are installed
            assert bad(result[name])
            assert name in missed
