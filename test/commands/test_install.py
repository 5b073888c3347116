"""`nics install`: message packages that the wheels of ROS 2 lack."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from command_line import nics

from nics_drl_bridge.commands import install, message_build
from nics_drl_bridge.nodes import message_packages
from nics_drl_bridge.nodes.message_packages import (
    Wheels,
    how_to_install,
    shipped_packages,
)

WHEELS = Wheels("ros-", {"ros-rclpy": "9.1.2"})
USE = """
from rclpy.type_support import check_for_type_support
from tf2_msgs.msg import TFMessage
check_for_type_support(TFMessage)
print(TFMessage.get_fields_and_field_types())
"""


@pytest.fixture
def absent(monkeypatch):
    """An environment with the wheels and without messages beside theirs."""
    monkeypatch.setattr(install, "find_spec", lambda name: None)
    monkeypatch.setattr(install, "wheels_here", lambda: WHEELS)


def test_the_files_of_tf2_msgs_come_with_the_package():
    file = shipped_packages()["tf2_msgs"] / "msg" / "TFMessage.msg"
    assert file.read_text(encoding="utf-8").split() == [
        "geometry_msgs/TransformStamped[]",
        "transforms",
    ]


def test_an_unknown_package_gets_the_nearest(absent, tmp_path):
    done = nics("install", "tf_msgs", cwd=tmp_path)
    assert done.returncode == 2
    assert "unknown message package 'tf_msgs'; did you mean 'tf2_msgs'?" in done.stderr


def test_a_missing_compiler_is_one_sentence_with_the_fix(absent, tmp_path, monkeypatch):
    monkeypatch.setattr(message_build.shutil, "which", lambda name: None)
    done = nics("install", "tf2_msgs", cwd=tmp_path)
    assert done.returncode == 2
    assert "install cmake and make and a C++ compiler" in done.stderr
    assert "sudo apt install cmake make g++" in done.stderr


def test_a_ros_of_a_distribution_installs_its_own(absent, tmp_path, monkeypatch):
    monkeypatch.setattr(install, "wheels_here", lambda: None)
    monkeypatch.setattr(install, "find_spec", lambda name: name == "rclpy" or None)
    monkeypatch.setenv("ROS_DISTRO", "kilted")
    done = nics("install", "tf2_msgs", cwd=tmp_path)
    assert done.returncode == 2
    assert "sudo apt install ros-kilted-tf2-msgs" in done.stderr


def test_what_is_installed_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(install, "find_spec", lambda name: True)
    done = nics("install", "tf2_msgs", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stdout == "tf2_msgs is installed already\n"


def test_only_what_the_wheels_lack_and_this_package_has_is_named(monkeypatch):
    monkeypatch.setattr(message_packages, "wheels_here", lambda: WHEELS)
    assert how_to_install("tf2_msgs") == "install it by `nics install tf2_msgs`"
    assert how_to_install("nav2_msgs") == "install it with your ROS 2 distribution"
    monkeypatch.setattr(message_packages, "wheels_here", lambda: None)
    assert how_to_install("tf2_msgs") == "install it with your ROS 2 distribution"


@pytest.mark.campaign
@pytest.mark.process
@pytest.mark.timeout(1200)
def test_the_messages_that_were_built_can_be_used(tmp_path):
    if message_packages.wheels_here() is None:
        pytest.skip("needs the wheels of ROS 2")
    done = nics("install", "tf2_msgs", "--prefix", tmp_path / "built", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    prefix = (tmp_path / "built").resolve()
    environment = {
        **os.environ,
        "PYTHONPATH": str(message_build.find_modules_folder(prefix)),
    }
    libraries = os.environ.get("LD_LIBRARY_PATH", "")
    environment["LD_LIBRARY_PATH"] = f"{prefix / 'lib'}{os.pathsep}{libraries}"
    used = subprocess.run(
        [sys.executable, "-c", USE], env=environment, capture_output=True, text=True
    )
    assert "sequence<geometry_msgs/TransformStamped>" in used.stdout, used.stderr
