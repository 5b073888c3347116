from __future__ import annotations

import multiprocessing
from unittest.mock import Mock

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.nodes import faulty_robot

pytestmark = pytest.mark.ros


def test_the_base_ends_with_the_process_that_started_it(monkeypatch):
    executor = Mock()
    executor.spin_once.side_effect = [None, None]  # not more often
    parent = Mock()
    parent.is_alive.side_effect = [True, True, False]
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: parent)
    monkeypatch.setattr(faulty_robot, "driver_context", Mock())
    monkeypatch.setattr(faulty_robot, "Node", Mock())
    monkeypatch.setattr(
        faulty_robot, "SingleThreadedExecutor", Mock(return_value=executor)
    )
    faulty_robot.hear(None, Mock())
    for call in executor.spin_once.call_args_list:
        assert call.kwargs["timeout_sec"] <= 1.0
