"""The soak of the whole stack in small: everything runs beside everything, and tells its use."""

from __future__ import annotations

import pytest

from .runs import CAMPAIGNS, asked, fails

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
SCRIPT = "soak.py"


@pytest.mark.campaign
def test_the_whole_stack_drives_and_begins_episodes_and_keeps_its_files_and_threads():
    code, result = asked(SCRIPT, "--minutes", "0.2", "--warm-up", "0.1")
    assert result["resets"] > 0
    assert result["steps"] > result["resets"]
    assert result["driven_m"] > 0.4
    assert result["driven_in_episodes_m"] > 0.2
    assert set(result) >= {"rss_growth_mb", "unexplained_stops", "goals_reached"}
    assert (result["fds_growth"], result["threads_growth"]) == (0, 0)
    # On a busy machine data come late, which stops a robot.
    assert all(line.startswith("unexplained_stops") for line in result["failures"])
    assert code == bool(result["failures"])


@pytest.mark.campaign
def test_a_robot_that_never_moves_has_shown_nothing():
    missed = fails(SCRIPT, "standing", "--minutes", "0.05", "--warm-up", "0.0")
    assert any(line.startswith("driven_m 0.0: must be 0.1 at least") for line in missed)


@pytest.mark.campaign
def test_a_file_that_each_episode_leaves_open_is_found():
    missed = fails(SCRIPT, "leak", "--minutes", "0.2", "--warm-up", "0.0")
    assert any(line.startswith("fds_growth ") for line in missed)


def test_a_figure_that_is_nan_misses_its_bar(monkeypatch):
    monkeypatch.syspath_prepend(str(CAMPAIGNS))
    import soak

    names = [*soak.MOST, *soak.LEAST, *soak.LEAST_PER_MINUTE, "driven_in_episodes_m"]
    result = dict.fromkeys(names, float("nan")) | {"minutes": 1.0}
    assert len(soak.bars(result)) == len(names)
