import numpy as np
import pytest

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import load_robot

from ..physics.driving import drive_steadily

pytest.importorskip("dartpy", reason="needs DART: the extra `dart`")

from nics_drl_bridge.extras.dart.simulator import DartRobot

WHEEL = """
<link name="{name}"><inertial><mass value="2.6"/>
  <inertia ixx="0.02" iyy="0.035" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin rpy="1.5707963 0 0"/>
    <geometry><cylinder radius="0.098" length="0.04"/></geometry></collision></link>
<joint name="{name}_joint" type="continuous"><parent link="chassis"/><child link="{name}"/>
  <origin xyz="{x} {y} 0.098"/><axis xyz="0 {axis} 0"/></joint>"""
CHASSIS = """
<link name="base_footprint"/>
<joint name="up" type="fixed"><parent link="base_footprint"/><child link="chassis"/></joint>
<link name="chassis"><inertial><origin xyz="0 0 0.1"/><mass value="16"/>
  <inertia ixx="0.3" iyy="0.4" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.15"/><geometry><box size="0.42 0.3 0.1"/></geometry></collision>
</link>"""
PLACES = {
    "wheel_a": (0.131, 0.187, 1),
    "wheel_b": (0.131, -0.187, -1),  # turned round
    "wheel_c": (-0.131, 0.187, 1),
    "wheel_d": (-0.131, -0.187, 1),
}


def write_urdf(folder, places):
    wheels = (
        WHEEL.format(name=name, x=x, y=y, axis=axis)
        for name, (x, y, axis) in places.items()
    )
    file = folder / "robot.urdf"
    file.write_text(f"<robot name='own'>{CHASSIS}{''.join(wheels)}</robot>")
    return file


def test_a_robot_of_a_urdf_file_drives_by_the_wheels_at_its_corners(tmp_path):
    spec = load_robot("jackal")
    robot = DartRobot(spec, file=write_urdf(tmp_path, PLACES))
    straight, *_ = drive_steadily(robot, [0.5, 0.0], 2.5)
    assert straight == pytest.approx([0.5, 0.0, 0.0], abs=0.02)
    turning, state, _ = drive_steadily(robot, [0.0, 1.0], 2.0)
    assert 0.5 < turning[2] < 1.5
    assert state[0] < 0.0 < state[1]
    by_wheels = (state[1] - state[0]) * spec.parameters["wheel_radius"] / (2 * 0.187)
    assert by_wheels > 1.2 * turning[2]  # they skid


def test_a_robot_of_an_sdf_file_drives_too(tmp_path):
    inertia = "<inertia><ixx>{0}</ixx><iyy>{0}</iyy><izz>{0}</izz>"
    inertia += "<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia>"
    body = f"<inertial><mass>4</mass>{inertia.format(0.05)}</inertial>"
    links = f"<link name='base'>{body}</link>"
    for name, y in (("one", 0.12), ("two", -0.12)):
        links += f"""
          <link name='{name}'><pose>0 {y} 0 0 0 0</pose>
            <inertial><mass>0.5</mass>{inertia.format(0.001)}</inertial>
            <collision name='c'><geometry><sphere><radius>0.05</radius></sphere></geometry>
            </collision></link>
          <joint name='{name}_joint' type='revolute'><parent>base</parent>
            <child>{name}</child><axis><xyz>0 1 0</xyz></axis></joint>"""
    links += f"""<link name='ball'><pose>-0.1 0 -0.03 0 0 0</pose>
      <inertial><mass>0.1</mass>{inertia.format(0.0001)}</inertial>
      <collision name='c'><geometry><sphere><radius>0.02</radius></sphere></geometry>
      </collision></link>
      <joint name='b' type='fixed'><parent>base</parent><child>ball</child></joint>"""
    file = tmp_path / "robot.sdf"
    file.write_text(f"<sdf version='1.6'><model name='m'>{links}</model></sdf>")
    robot = DartRobot(load_robot("differential"), file=file)
    twist, *_ = drive_steadily(robot, [0.3, 0.0], 1.0)
    assert twist[0] == pytest.approx(0.3, rel=0.1)


def test_a_small_wheel_of_a_castor_does_not_change_the_height_of_a_robot(tmp_path):
    spec = load_robot("jackal")
    file = write_urdf(tmp_path, PLACES)
    castor = WHEEL.format(name="castor", x=0.0, y=0.0, axis=1)
    small = castor.replace("0.098", "0.03")
    file.write_text(file.read_text().replace("</robot>", f"{small}</robot>"))
    heights = []
    for robot in (DartRobot(spec, file=file), DartRobot(spec)):
        robot.reset(np.zeros(3))
        heights.append(robot.rig.base.getTransform().translation()[2])
    assert heights[0] == pytest.approx(heights[1] - 0.098, abs=1e-6)  # of its footprint


def test_a_file_whose_robot_is_fixed_to_the_world_is_refused(tmp_path):
    file = write_urdf(tmp_path, PLACES)
    fixed = "<link name='world'/><joint name='hold' type='fixed'><parent link='world'/>"
    fixed += "<child link='base_footprint'/></joint></robot>"
    file.write_text(file.read_text().replace("</robot>", fixed))
    with pytest.raises(ConfigError, match="give it a free base"):
        DartRobot(load_robot("jackal"), file=file)


def test_a_file_whose_wheels_do_not_fit_is_refused_by_the_joint(tmp_path):
    three = {name: PLACES[name] for name in ("wheel_a", "wheel_b", "wheel_c")}
    file = write_urdf(tmp_path, three)
    with pytest.raises(
        ConfigError,
        match="0 joints could be 'rear_right', where one is needed; it has wh",
    ):
        DartRobot(load_robot("jackal"), file=file)
    file.write_text("<robot>")
    with pytest.raises(ConfigError, match="can't read it"):
        DartRobot(load_robot("jackal"), file=file)
    with pytest.raises(ConfigError, match="no such file"):
        DartRobot(load_robot("jackal"), file=tmp_path / "none.urdf")
