import sys
from dataclasses import replace

import numpy as np
import pytest

from nics_drl_bridge import geometry
from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.extras.dart.scenery import load_dart
from nics_drl_bridge.extras.dart.simulator import PHYSICS, DartRobot
from nics_drl_bridge.extras.physics.simulator import Reading, record
from nics_drl_bridge.recording.recording import check
from nics_drl_bridge.robot.kinds import textbook
from nics_drl_bridge.robot.spec import RobotSpec, load_robot

NAMES = ("ackermann", "differential", "mecanum", "jackal")

try:
    load_dart()
    MISSING = False
except ConfigError:
    MISSING = True
needs_dart = pytest.mark.skipif(MISSING, reason="needs DART: the extra `dart`")


@pytest.fixture(scope="module")
def robots() -> dict[str, DartRobot]:
    return {name: DartRobot(load_robot(name)) for name in NAMES}


def drive_steadily(
    robot: DartRobot, command, settle_s: float = 1.0
) -> tuple[np.ndarray, np.ndarray, Reading]:
    """Mean twist (3,) and state of half a second under a command, and the last reading."""
    robot.reset(np.zeros(3))
    robot.step(command, settle_s)
    readings = [robot.step(command, 0.01) for _ in range(50)]
    twist, state = (
        np.mean([getattr(r, name) for r in readings], axis=0)
        for name in ("twist", "state")
    )
    return twist, state, readings[-1]


@needs_dart
@pytest.mark.parametrize("name", NAMES)
def test_it_stands_still_without_a_command(robots, name):
    reading = robots[name].reset([1.0, -2.0, 3.0])
    assert reading.time == 0.0
    assert np.allclose(reading.pose, [1.0, -2.0, 3.0])
    rest = robots[name].step(np.zeros(len(robots[name].spec.command)), 1.0)
    assert np.allclose(rest.pose, reading.pose, atol=3e-3)
    assert rest.time == pytest.approx(1.0)


@needs_dart
@pytest.mark.parametrize("name", NAMES)
def test_it_drives_straight_ahead(robots, name):
    robot = robots[name]
    command = np.zeros(len(robot.spec.command))
    command[0] = 0.4
    twist, _, reading = drive_steadily(robot, command, 3.0)
    assert twist[0] == pytest.approx(0.4, rel=0.02)
    assert abs(reading.pose[1]) < 0.01
    assert abs(reading.pose[2]) < 0.01


@needs_dart
@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("ackermann", [0.4, 0.3]),
        ("differential", [0.4, 0.8]),
        ("mecanum", [0.3, 0.0, 1.0]),
    ],
)
def test_it_turns_as_the_textbook_says(robots, name, command):
    robot = robots[name]
    book = textbook(robot.spec)
    expected = book.twist(book.target(np.array(command)))
    left, *_ = drive_steadily(robot, command)
    right, *_ = drive_steadily(robot, [*command[:-1], -command[-1]])
    assert left == pytest.approx(expected, rel=0.03, abs=0.02)
    assert right[2] == pytest.approx(-left[2], rel=0.03)


@needs_dart
@pytest.mark.parametrize("command", [[0.0, 2.0], [1.0, 1.0]])
def test_a_jackal_skids_in_turns_as_friction_of_any_direction_lets_it(robots, command):
    """The wheels' speeds are made by 1.5 times the distance between them."""
    robot = robots["jackal"]
    twist, state, _ = drive_steadily(robot, command, 2.0)
    assert twist[2] == pytest.approx(command[1], rel=0.1)
    p = robot.spec.parameters
    turned_by = (state[1] - state[0]) * p["wheel_radius"] / twist[2]
    assert turned_by > 1.3 * 2.0 * p["half_width"]


@needs_dart
def test_a_mecanum_robot_moves_sideways_to_the_left(robots):
    twist, _, reading = drive_steadily(robots["mecanum"], [0.0, 0.5, 0.0])
    assert twist[1] == pytest.approx(0.5, rel=0.05)
    assert abs(twist[0]) < 0.02
    assert abs(reading.pose[2]) < 0.05


@needs_dart
@pytest.mark.parametrize("name", ["ackermann", "differential"])
def test_a_robot_that_turns_round_knows_where_it_is_by_its_encoders(robots, name):
    robot = robots[name]
    pose = np.zeros(3)
    low = robot.spec.command_low
    high = robot.spec.command_high
    reading = robot.reset(pose)
    for step in range(200):
        before = reading
        reading = robot.step(high * [1.0, 0.0] if step > 100 else low, 0.01)
        twist = textbook(robot.spec).twist(0.5 * (before.state + reading.state))
        pose = geometry.compose(pose, geometry.exp(0.01 * twist))
    off = geometry.between(reading.pose, pose)
    assert np.hypot(*off[:2]) < 0.02
    assert abs(off[2]) < 0.02


@needs_dart
def test_commands_saturate_at_the_limits_of_the_spec(robots):
    robot = robots["differential"]
    robot.reset(np.zeros(3))
    at_limit = robot.step(robot.spec.command_high, 0.2)
    robot.reset(np.zeros(3))
    beyond = robot.step(10.0 * robot.spec.command_high, 0.2)
    assert np.array_equal(at_limit.pose, beyond.pose)


@needs_dart
def test_on_slippery_ground_a_car_slides_out_of_its_turn(robots):
    ice = DartRobot(robots["ackermann"].spec, replace(PHYSICS, friction=0.1))
    dry, *_ = drive_steadily(robots["ackermann"], [1.0, 0.4])
    icy, *_ = drive_steadily(ice, [1.0, 0.4])
    assert abs(dry[1]) < 0.02 * dry[0]
    assert abs(icy[1]) > 0.1 * abs(icy[0])


@needs_dart
def test_a_robot_that_falls_over_says_so(robots):
    data = robots["ackermann"].spec.model_dump()
    data["command"][0]["max"] = 8.0
    fast = RobotSpec.model_validate(data)
    robot = DartRobot(fast, replace(PHYSICS, friction=5.0, acceleration=20.0))
    robot.step([8.0, 0.0], 1.0)
    with pytest.raises(BackendError, match="fallen over"):
        robot.step([8.0, 0.5], 0.5)


@needs_dart
def test_a_drive_is_a_recording_of_this_robot(robots):
    spec = robots["ackermann"].spec
    recording = record(robots["ackermann"], np.random.default_rng(0), duration=2.0)
    assert check(recording, spec) is recording
    assert recording.source == "DART ackermann"


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


@needs_dart
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


@needs_dart
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


@needs_dart
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


@needs_dart
def test_a_file_whose_robot_is_fixed_to_the_world_is_refused(tmp_path):
    file = write_urdf(tmp_path, PLACES)
    fixed = "<link name='world'/><joint name='hold' type='fixed'><parent link='world'/>"
    fixed += "<child link='base_footprint'/></joint></robot>"
    file.write_text(file.read_text().replace("</robot>", fixed))
    with pytest.raises(ConfigError, match="give it a free base"):
        DartRobot(load_robot("jackal"), file=file)


@needs_dart
def test_a_file_whose_wheels_do_not_fit_is_refused_by_the_joint(tmp_path):
    three = {name: PLACES[name] for name in ("wheel_a", "wheel_b", "wheel_c")}
    file = write_urdf(tmp_path, three)
    with pytest.raises(
        ConfigError, match="one joint as 'rear_right', not 0; it has wh"
    ):
        DartRobot(load_robot("jackal"), file=file)
    file.write_text("<robot>")
    with pytest.raises(ConfigError, match="can't read it"):
        DartRobot(load_robot("jackal"), file=file)
    with pytest.raises(ConfigError, match="no such file"):
        DartRobot(load_robot("jackal"), file=tmp_path / "none.urdf")


def test_a_missing_library_is_one_sentence_that_names_the_fix(monkeypatch):
    monkeypatch.setitem(sys.modules, "dartpy", None)
    with pytest.raises(ConfigError, match=r"pip install 'nics_drl_bridge\[dart\]'"):
        load_dart()
