import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.generator import mount_lidar
from nics_drl_bridge.robot.spec import RobotSpec, load_robot
from nics_drl_bridge.robot.urdf import make_urdf

ROOT = Path(__file__).resolve().parents[2]
ROBOTS = ("ackermann", "differential", "mecanum", "jackal")


def joints(text: str) -> dict[str, ElementTree.Element]:
    return {
        joint.attrib["name"]: joint
        for joint in ElementTree.fromstring(text).iter("joint")
    }


def place(text: str, link: str) -> np.ndarray:
    """x, y, z of a link in base_link, where no joint is turned."""
    at = np.zeros(3)
    parents = {j.find("child").attrib["link"]: j for j in joints(text).values()}
    while link in parents:
        at += [
            float(word) for word in parents[link].find("origin").attrib["xyz"].split()
        ]
        link = parents[link].find("parent").attrib["link"]
    assert link == "base_link"
    return at


def wheels(text: str) -> dict[str, float]:
    """Links of wheels and their radii."""
    links = ElementTree.fromstring(text).iter("link")
    return {
        link.attrib["name"]: float(
            link.find("visual/geometry/cylinder").attrib["radius"]
        )
        for link in links
        if link.attrib["name"].endswith("_wheel_link")
    }


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shipped_files_are_those_of_the_shipped_robots(name):
    lidar = mount_lidar(load_robot(name))
    file = ROOT / "urdf" / f"{name}.urdf"
    assert file.read_text(encoding="utf-8") == make_urdf(
        load_robot(name), lidar.mount, lidar.frame
    )


def test_the_command_tells_the_file_that_it_wrote(tmp_path: Path):
    file = str(tmp_path / "car.urdf")
    told = CliRunner().invoke(app, ["urdf", "ackermann", "--out", file, "--json"])
    assert json.loads(told.stdout) == {"file": file, "robot": "ackermann"}
    assert Path(file).is_file()


@pytest.mark.parametrize("name", ROBOTS)
def test_it_is_one_tree_below_base_link(name):
    text = make_urdf(load_robot(name))
    root = ElementTree.fromstring(text)
    links = [link.attrib["name"] for link in root.iter("link")]
    children = [joint.find("child").attrib["link"] for joint in root.iter("joint")]
    assert len(set(links)) == len(links)
    assert sorted([*children, "base_link"]) == sorted(links)
    assert {"base_link", "laser"} <= set(links)
    materials = {one.attrib["name"] for one in root.findall("material")}
    assert {one.attrib["name"] for one in root.iter("material")} == materials


@pytest.mark.parametrize("name", ROBOTS)
def test_wheels_stand_on_the_ground_and_move_as_joint_states_says(name):
    spec = load_robot(name)
    text = make_urdf(spec)
    assert wheels(text)
    for link, radius in wheels(text).items():
        assert place(text, link)[2] == pytest.approx(radius)
    movable = {
        key for key, joint in joints(text).items() if joint.attrib["type"] != "fixed"
    }
    mimics = {
        key for key, joint in joints(text).items() if joint.find("mimic") is not None
    }
    assert movable - mimics <= {variable.name for variable in spec.state}
    turning = [j for j in joints(text).values() if j.attrib["type"] == "continuous"]
    assert all(joint.find("axis").attrib["xyz"] == "0 1 0" for joint in turning)


def test_the_laser_stands_at_its_mount():
    text = make_urdf(
        load_robot("differential"), (0.1, -0.02, 1.5), "front_laser", "car"
    )
    origin = joints(text)["laser_mount"].find("origin").attrib
    assert (origin["xyz"], origin["rpy"]) == ("0.1 -0.02 0", "0 0 1.5")
    assert joints(text)["laser_mount"].find("child").attrib["link"] == "front_laser"
    assert joints(text)["laser_mount"].find("parent").attrib["link"] == "car"


def test_a_robot_without_textbook_kinematics_has_a_body_and_a_laser():
    data = load_robot("differential").model_dump() | {"textbook": None}
    text = make_urdf(RobotSpec(**data))
    assert not wheels(text)
    assert set(joints(text)) == {"laser_mount"}
