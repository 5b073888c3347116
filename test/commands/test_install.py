"""`nics install`: message packages that the wheels of ROS 2 lack."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from command_line import nics

from nics_drl_bridge.commands import install, message_build
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import message_packages
from nics_drl_bridge.nodes.message_packages import (
    Wheels,
    explain_install,
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
    monkeypatch.setattr(install, "find_wheels", lambda: WHEELS)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tf_msgs", "unknown message package 'tf_msgs'; did you mean 'tf2_msgs'?"),
        ("leg_msgs", "leg_msgs: contains none of msg/*.msg, srv/*.srv, action/"),
        ("tf2_msgs", "sudo apt install cmake make g++"),
        ("ackermann_msgs", "sudo apt install ros-kilted-ackermann-msgs"),
    ],
)
def test_what_can_not_be_built_is_one_sentence(
    absent, tmp_path, monkeypatch, name, said
):
    (tmp_path / "leg_msgs").mkdir()
    monkeypatch.setattr(message_build.shutil, "which", lambda name: None)
    if name == "ackermann_msgs":  # beside a ROS 2 of a distribution
        monkeypatch.setattr(install, "find_wheels", lambda: None)
        monkeypatch.setattr(install.extensions, "require", lambda user, module: None)
        monkeypatch.setenv("ROS_DISTRO", "kilted")
    done = nics("install", name, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr


def test_what_is_installed_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(install, "find_spec", lambda name: True)
    monkeypatch.setattr(install, "check_import", lambda name: None)
    done = nics("install tf2_msgs", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stdout == "tf2_msgs is already installed\n"


def test_a_broken_build_is_built_again(tmp_path, monkeypatch):
    def fail(name):
        raise ConfigError(f"{name} is installed, but can't be imported: no library")

    monkeypatch.setattr(install, "find_spec", lambda name: True)
    monkeypatch.setattr(install, "check_import", fail)
    monkeypatch.setattr(install, "find_wheels", lambda: WHEELS)
    monkeypatch.setattr(message_build.shutil, "which", lambda name: None)
    done = nics("install tf2_msgs", cwd=tmp_path)
    assert done.stdout == ""
    assert "can't be imported: no library; building it again" in done.stderr
    assert "install cmake and make" in done.stderr


@pytest.fixture
def generators(monkeypatch, tmp_path):
    """Generators that run nothing, and have `std_msgs` alone."""
    monkeypatch.setattr(message_build.Generators, "_install", lambda self, wheels: None)
    monkeypatch.setattr(message_build.Generators, "_run", lambda self, *words: None)
    monkeypatch.setattr(message_build, "check_programs", lambda: None)
    with message_build.Generators(WHEELS, lambda line: None) as made:
        (made._prefix / "share" / "std_msgs").mkdir(parents=True)
        made._environment |= {"AMENT_PREFIX_PATH": "a", "CMAKE_PREFIX_PATH": "c"}
        yield made


def write_package(folder, files, name=None):
    for file, text in files.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    if name is not None:
        (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    return message_build.read_source(folder)


def test_a_package_has_the_name_in_its_package_xml(tmp_path):
    files = {"msg/Arm.msg": "int32 x\n"}
    assert write_package(tmp_path / "arms-main", files, "arm_msgs").name == "arm_msgs"
    assert write_package(tmp_path / "leg_msgs", files).name == "leg_msgs"
    with pytest.raises(ConfigError, match="'legs-main' is not a valid package name"):
        write_package(tmp_path / "legs-main", files)


def test_a_message_goes_with_the_one_that_it_uses(generators, tmp_path):
    files = {
        "msg/Alone.msg": "std_msgs/Header header\n",
        "msg/Missing.msg": "far_msgs/Thing thing\n",
        "msg/Uses.msg": "int32 x\nMissing[] them\n",
        "srv/UsesThat.srv": "leg_msgs/Uses it\n---\nbool done\n",
    }
    found = generators.find_interfaces(write_package(tmp_path / "leg_msgs", files))
    assert [file.name for file in found.files] == ["Alone.msg"]
    assert found.left_out == dict.fromkeys(
        ("Missing.msg", "Uses.msg", "UsesThat.srv"), "far_msgs"
    )


def test_a_package_can_use_one_that_was_just_built(generators, tmp_path):
    legs = write_package(tmp_path / "leg_msgs", {"msg/Leg.msg": "arm_msgs/Arm arm\n"})
    arms = write_package(tmp_path / "arm_msgs", {"msg/Arm.msg": "int32 x\n"})
    assert message_build.sort_by_use([legs, arms]) == [arms, legs]
    with pytest.raises(ConfigError, match="contains no"):
        generators.find_interfaces(legs)
    generators.build(generators.find_interfaces(arms), tmp_path / "built")
    assert generators.find_interfaces(legs).needed == ["arm_msgs"]
    built = f"c{os.pathsep}{tmp_path / 'built'}"
    assert generators._environment["CMAKE_PREFIX_PATH"] == built
    write_package(tmp_path / "arm_msgs", {"msg/Arm.msg": "leg_msgs/Leg leg\n"})
    with pytest.raises(ConfigError, match="arm_msgs and leg_msgs depend on each other"):
        message_build.sort_by_use([legs, arms])


def test_a_prefix_with_a_space_and_a_dollar_can_be_sourced(tmp_path):
    prefix = tmp_path / "my $HOME"
    prefix.mkdir()
    script = f"source '{message_build.write_setup(prefix)}' && echo \"$PYTHONPATH\""
    done = subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        env={"PYTHONPATH": "b c"},
    )
    assert done.stdout == f"{message_build.find_modules_folder(prefix)}:b c\n"


def test_only_what_the_wheels_lack_and_this_package_has_is_named(monkeypatch):
    monkeypatch.setattr(message_packages, "find_wheels", lambda: WHEELS)
    assert explain_install("tf2_msgs") == "install it by `nics install tf2_msgs`"
    assert explain_install("nav2_msgs") == "install it with your ROS 2 distribution"
    monkeypatch.setattr(message_packages, "find_wheels", lambda: None)
    assert explain_install("tf2_msgs") == "install it with your ROS 2 distribution"


@pytest.mark.package
@pytest.mark.process
@pytest.mark.timeout(1200)
def test_the_messages_that_were_built_can_be_used(tmp_path):
    if message_packages.find_wheels() is None:
        pytest.skip("needs the wheels of ROS 2")
    done = nics("install tf2_msgs --prefix", tmp_path / "built", cwd=tmp_path)
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
