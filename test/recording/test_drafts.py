"""Drafts of mappings in the styles of public data sets: right or blank, and never wrong."""

import re
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from nics_drl_bridge.config import parse_yaml
from nics_drl_bridge.recording.survey import split_unit

from .tables import draft, read_draft, write

COUNT = 600
STEP = 0.05


def motion() -> dict[str, np.ndarray]:
    """A winding drive at 20 Hz: commands that change each second, and a robot that follows."""
    rng = np.random.default_rng(3)
    t = np.arange(COUNT) * STEP
    v = np.repeat(rng.uniform(0.2, 1.0, COUNT // 20), 20)
    w = np.repeat(rng.uniform(-0.8, 0.8, COUNT // 20), 20)
    speed, rate = lfilter([0.0, 0.25], [1.0, -0.75], [v, w])
    yaw = np.cumsum(rate) * STEP
    x = np.cumsum(speed * np.cos(yaw)) * STEP
    y = np.cumsum(speed * np.sin(yaw)) * STEP
    wrapped = np.arctan2(np.sin(yaw), np.cos(yaw))
    zero = np.zeros(COUNT)
    return {
        "t": t,
        "x": x,
        "y": y,
        "yaw": wrapped,
        "v": v,
        "w": w,
        "speed": speed,
        "rate": rate,
        "qz": np.sin(yaw / 2.0),
        "qw": np.cos(yaw / 2.0),
        "zero": zero,
        "noise": rng.normal(size=COUNT),
        "left": np.floor(np.cumsum(speed - 0.2 * rate) * 400.0),
        "right": np.floor(np.cumsum(speed + 0.2 * rate) * 400.0),
        "lat": 47.5 + y * 9e-6,
        "lon": 8.7 + x * 13e-6,
        "row": np.arange(COUNT),
        "ns": t * 1e9 + 1.4e18,
        "ms": t * 1e3,
        "x_mm": x * 1e3,
        "y_mm": y * 1e3,
        "yaw_deg": np.degrees(wrapped),
        "w_deg": np.degrees(w),
        "high": rng.normal(size=COUNT) + 1.5,
    }


M = motion()
# Columns, by the signals of `motion`; then those that are to be guessed for x, as heading or
# quaternion, and as commands.
TABLES = """
issue:
  time=t, x(m)=x, y(m)=y, phi(rad)=yaw, cmd_vel_x=v, cmd_vel_omega=w
  -> x(m); phi(rad); forward_command=cmd_vel_x, turn_command=cmd_vel_omega
kitti oxts:
  lat, lon, alt=zero, roll=noise, pitch=noise, yaw, vn=speed, ve=speed, vf=speed,
  vl=zero, vu=zero, ax=noise, ay=noise, az=noise, wx=noise, wy=noise, wz=rate
  -> lon; yaw;
tum:
  timestamp=t, tx=x, ty=y, tz=zero, qx=zero, qy=zero, qz, qw
  -> tx; qx, qy, qz, qw;
euroc:
  #timestamp=ns, p_RS_R_x [m]=x, p_RS_R_y [m]=y, p_RS_R_z [m]=zero, q_RS_w []=qw,
  q_RS_x []=zero, q_RS_y []=zero, q_RS_z []=qz, v_RS_R_x [m s^-1]=speed, v_RS_R_y [m
  s^-1]=zero, w_RS_S_z [rad s^-1]=rate
  -> p_RS_R_x [m]; q_RS_x [], q_RS_y [], q_RS_z [], q_RS_w [];
euroc imu:
  timestamp [ns]=ns, w_RS_S_x [rad s^-1]=noise, w_RS_S_y [rad s^-1]=noise, w_RS_S_z
  [rad s^-1]=rate, a_RS_S_x [m s^-2]=noise, a_RS_S_y [m s^-2]=noise
  -> ; ;
odometry only:
  t, odom_x=x, odom_y=y, odom_theta=yaw, odom_v=speed, odom_w=rate
  -> odom_x; odom_theta;
bare v and w:
  t, x, y, theta=yaw, v=speed, w=rate
  -> x; theta;
truth beside odometry and slam:
  t, gt_x=x, gt_y=y, gt_yaw=yaw, odom_x=noise, odom_y=noise, odom_yaw=noise,
  slam_x=x, slam_y=y, slam_yaw=yaw, cmd_v=v, cmd_w=w
  -> gt_x; gt_yaw; forward_command=cmd_v, turn_command=cmd_w
slam positions:
  t, orb_x=x, orb_y=y, orb_z=zero, lio_x=x, lio_y=y
  -> ; ;
rostopic echo of odometry:
  %time=ns, field.header.seq=row, field.pose.pose.position.x=x,
  field.pose.pose.position.y=y, field.pose.pose.position.z=zero,
  field.pose.pose.orientation.x=zero, field.pose.pose.orientation.y=zero,
  field.pose.pose.orientation.z=qz, field.pose.pose.orientation.w=qw,
  field.pose.covariance0=noise, field.twist.twist.linear.x=speed,
  field.twist.twist.angular.z=rate, field.twist.covariance0=noise
  -> field.pose.pose.position.x; field.pose.pose.orientation.x,
     field.pose.pose.orientation.y, field.pose.pose.orientation.z,
     field.pose.pose.orientation.w;
lidar beams:
  t, x, y, yaw, cmd_vel=v, range_0=noise, range_1=noise, scan[0]=noise,
  scan[1]=noise
  -> x; yaw;
covariances:
  t, pose_x=x, pose_y=y, pose_yaw=yaw, cov_xx=noise, cov_yy=noise, cov_yawyaw=noise,
  sigma_v=noise, cmd_covariance=noise
  -> pose_x; pose_yaw;
f1tenth:
  t, pose_x=x, pose_y=y, pose_theta=yaw, speed, steering_angle=w, cmd_speed=v,
  cmd_steering_angle=w
  -> pose_x; pose_theta; speed_command=cmd_speed,
     steering_command=cmd_steering_angle
f1tenth, measured only:
  t, pose_x=x, pose_y=y, pose_theta=yaw, speed, steering_angle=w
  -> pose_x; pose_theta;
jetracer:
  t, vicon x=x, vicon y=y, vicon yaw=yaw, W (IMU)=rate, vel encoder=speed,
  throttle=v, steering=w
  -> vicon x; vicon yaw; throttle=throttle, steering=steering
agv:
  time_ms=ms, agv_x_mm=x_mm, agv_y_mm=y_mm, agv_heading_deg=yaw_deg,
  act_speed=speed, set_speed=v, set_steer_deg=w_deg, act_steer_deg=w_deg,
  battery_voltage=noise, motor_current=noise
  -> agv_x_mm; agv_heading_deg; speed_command=set_speed,
     steering_command=set_steer_deg
encoder ticks:
  t, cam_x=x, cam_y=y, cam_theta=yaw, left_ticks=left, right_ticks=right
  -> cam_x; cam_theta; left_wheel=left_ticks, right_wheel=right_ticks
ticks beside commands:
  t, x, y, yaw, left_ticks=left, right_ticks=right, v_cmd=v, w_cmd=w
  -> x; yaw; forward_command=v_cmd, turn_command=w_cmd
gps track:
  time=t, latitude=lat, longitude=lon, altitude=noise, speed, hdop=noise,
  satellites=noise
  -> ; ;
gps and imu:
  time=t, lat, lon, imu_yaw=yaw, imu_gyro_z=rate
  -> ; ;
phone imu:
  Time (s)=t, Acceleration x (m/s^2)=noise, Acceleration y (m/s^2)=noise,
  Acceleration z (m/s^2)=noise, Gyroscope z (rad/s)=rate
  -> ; ;
goals:
  t, x, y, yaw, goal_x=noise, goal_y=noise, goal_yaw=noise, target_x=noise,
  target_y=noise
  -> x; yaw;
sonars:
  t, x, y, yaw, left=noise, right=noise, front_left=noise, front_right=noise
  -> x; yaw;
wheel speeds, measured:
  t, x, y, yaw, wheel_speed_left [rad/s]=v, wheel_speed_right [rad/s]=w
  -> x; yaw; left_wheel=wheel_speed_left [rad/s], right_wheel=wheel_speed_right
     [rad/s]
references of a controller:
  t, x_m=x, y_m=y, psi_rad=yaw, v_ref_m_s=v, omega_ref_rad_s=w, v_m_s=speed,
  omega_rad_s=rate
  -> x_m; psi_rad; forward_command=v_ref_m_s, turn_command=omega_ref_rad_s
mecanum by its wheels:
  t, x, y, yaw, fl_cmd=v, fr_cmd=w, rl_cmd=speed, rr_cmd=rate
  -> x; yaw; front_left_wheel=fl_cmd, front_right_wheel=fr_cmd, rear_left_wheel=rl_cmd,
     rear_right_wheel=rr_cmd
revolutions:
  t, x, y, yaw, rpm_left=v, rpm_right=w
  -> x; yaw; left_wheel=rpm_left, right_wheel=rpm_right
fields of a twist:
  t, x, y, yaw, cmd_vel.linear.x=v, cmd_vel.linear.y=zero, cmd_vel.angular.z=w
  -> x; yaw; forward_command=cmd_vel.linear.x, turn_command=cmd_vel.angular.z
mecanum:
  t, x, y, yaw, cmd_vx=v, cmd_vy=noise, cmd_wz=w, vx=speed, vy=zero, wz=rate
  -> x; yaw; vx=cmd_vx, vy=cmd_vy, wz=cmd_wz
motors of a skid-steer:
  t, x, y, yaw, motor_left_cmd=v, motor_right_cmd=w, motor_left_current=noise,
  motor_right_current=noise
  -> x; yaw; left_wheel=motor_left_cmd, right_wheel=motor_right_cmd
yaw rate of a command:
  t, x, y, yaw, commanded_velocity=v, commanded_yaw_rate=w, yaw_rate=rate
  -> x; yaw; forward_command=commanded_velocity, turn_command=commanded_yaw_rate
pulses beside encoders:
  t, x, y, yaw, PWM_L=v, PWM_R=w, enc_L=left, enc_R=right
  -> x; yaw; left_wheel=PWM_L, right_wheel=PWM_R
uncertainties:
  t, x, y, yaw, v_rms=noise, omega_sd=noise, speed_uncertainty=noise,
  cmd_v_covar=noise
  -> x; yaw;
ranges to both sides:
  t, x, y, yaw, left_distance=noise, right_distance=noise, obstacle_speed=noise,
  obstacle_turn=noise
  -> x; yaw;
two commands of one meaning:
  t, x, y, yaw, cmd_v_raw=v, cmd_v_limited=speed, cmd_w=w
  -> x; yaw;
actions of a policy:
  t, x, y, yaw, action_0=v, action_1=w, reward=noise
  -> x; yaw;
drone:
  t, x, y, z=high, roll_cmd=noise, thrust_cmd=noise
  -> ; ;
nothing moves:
  t, x=zero, y=zero, yaw=zero, cmd_v=zero, cmd_w=zero
  -> ; ;
"""


def pick(columns: str) -> dict[str, np.ndarray]:
    """Columns `name=signal`, or `name` of the signal with that name."""
    pairs = (column.partition("=") for column in columns.split(", "))
    return {name: M[signal or name] for name, _, signal in pairs}


def read_tables() -> dict[str, tuple[dict[str, np.ndarray], str, list[str], Any]]:
    """Columns, x, heading or quaternion, and commands of each of `TABLES`."""
    tables = {}
    for table in re.split(r"\n(?=\w)", TABLES.strip()):
        style, columns, guesses = re.split(
            ": | -> ", " ".join(table.split()), maxsplit=2
        )
        x, turned, commands = (part.strip() for part in guesses.split(";"))
        named = dict(pair.split("=") for pair in commands.split(", ") if pair)
        tables[style] = pick(columns), x, turned.split(", "), named
    return tables


STYLES = read_tables()


def column_of(value: Any) -> str:
    return value["from"] if isinstance(value, dict) else (value or "")


@pytest.mark.parametrize("style", STYLES)
def test_a_draft_of_a_table_is_right_or_blank(tmp_path, style):
    columns, x, turned, commands = STYLES[style]
    path = write(tmp_path / "log.csv", columns)
    text, drafted = draft(path)
    pose = drafted["pose"]
    found = pose.get("quaternion") or [column_of(pose.get("heading"))]
    assert (pose["x"] or "", found) == (x, turned), text
    guessed = {
        name: column_of(value) for name, value in (drafted["command"] or {}).items()
    }
    assert guessed == commands, text
    if x and commands:
        assert read_draft(path, drafted).variables == tuple(commands)
        assert "# doubt" not in text
    if style in ("uncertainties", "ranges to both sides"):
        assert "\n#  " not in text  # what can't have been sent is no candidate


CANDIDATES = {
    "t, x, y, theta=yaw, v=speed, w=rate": "#  forward_command: v\n#  turn_command: w",
    "t, x, y, yaw, v, w, left_ticks=left, right_ticks=right": (
        "#  or forward_command: v\n#  or turn_command: w"
    ),
    "t, x, y, yaw, imu_wz=rate, vitesse=v, virage=w, still=zero": (
        "#  command_0: vitesse\n#  command_1: virage"
    ),
}


@pytest.mark.parametrize("columns", CANDIDATES)
def test_what_may_have_been_sent_is_listed_as_comments_to_uncomment(tmp_path, columns):
    path = write(tmp_path / "log.csv", pick(columns))
    text, drafted = draft(path)
    lines = CANDIDATES[columns]
    assert f"{lines}\n" in text
    assert "command_2" not in text
    assert "no command was recorded" not in text
    if drafted["command"] is None:
        chosen = parse_yaml(text.replace("#  ", "  "), "draft")
        assert read_draft(path, chosen).variables == tuple(chosen["command"])
    else:
        assert drafted["command"].keys() == {"left_wheel", "right_wheel"}
        told = "none is certain: the measured wheel motion is used instead"
        assert told in text


def test_columns_without_a_name_are_candidates(tmp_path):
    columns = pick("row, t, x, y, yaw, v, w")
    path = write(tmp_path / "drive.txt", columns, ", ")
    path.write_text(path.read_text().replace(", v, w", "", 1))
    text, drafted = draft(path)
    assert drafted["pose"] == {"x": "x", "y": "y", "heading": "yaw"}
    assert "#  command_0: 5\n#  command_1: 6\n" in text


UNITS = """
x(m): m; x [mm]: mm; yaw_deg: deg; phi(rad): rad; v [m s^-1]: m/s; w (deg/s): deg/s;
speed_kmh: km/h; left_rpm: rpm; motor_rpm_left_cmd: rpm; v_m_s: m/s; acc (m/s^2): m/s^2;
heading (°): deg; omega_rad_per_s: rad/s; q_w []: ; cov[0]: ; acc x (IMU):
"""


def test_units_are_read_from_names():
    for row in UNITS.split(";"):
        name, _, unit = row.strip().partition(":")
        assert split_unit(name)[1] == (unit.strip() or None), name


def switched(name: str, on: float, off: float) -> dict[str, np.ndarray]:
    """A drive with a switch that cut the motor for its second third, in which it stood."""
    cut = (M["t"] > 10.0) & (M["t"] < 20.0)
    shift = np.cumsum(np.where(cut, 0.0, 1.0)).astype(int) - 1
    pose = {key: M[key][shift] for key in ("x", "y", "yaw")}
    commands = pick("t, throttle=v, steering=w")
    return commands | pose | {name: np.where(cut, off, on)}


@pytest.mark.parametrize(
    ("name", "on", "off", "known"),
    [
        ("safety_value", 1.0, 0.0, True),
        ("estop", 0.0, 1.0, True),
        ("dead_man_switch", 1, 0, True),
        ("motors_on", 1, 0, True),
        ("motor_enable", 1234567, 0, True),
        ("light", 1.0, 0.0, False),
        ("enable", 1.0, 0.5, False),
        ("light_on", 1, 0, False),
    ],
)
def test_a_switch_of_two_values_is_recognised_by_name_and_values(
    tmp_path, name, on, off, known
):
    _, drafted = draft(write(tmp_path / "log.csv", switched(name, on, off)))
    throttle = {"from": "throttle", "when": {name: on}} if known else "throttle"
    assert drafted["command"] == {"throttle": throttle, "steering": "steering"}


@pytest.mark.parametrize("together", [True, False])
def test_all_of_several_switches_must_be_on_if_they_ever_are_together(
    tmp_path, together
):
    columns = switched("enabled", 1, 0)
    active = np.where(M["t"] < 1.0, 0, 1) if together else 1 - columns["enabled"]
    write(tmp_path / "log.csv", columns | {"active": active})
    (tmp_path / "empty.csv").write_text("t,volume\n")  # hides no switch of another
    throttle = draft(tmp_path)[1]["command"]["throttle"]
    if together:
        assert throttle["when"] == {"log.csv:enabled": 1, "log.csv:active": 1}
    else:
        assert throttle == "log.csv:throttle"


def test_the_car_of_the_validation_drive_is_drafted_whole(shared_recordings):
    file = shared_recordings / "jetracer_dart" / "long_prediction_69s.csv"
    _, drafted = draft(file)
    throttle = {"from": "throttle", "when": {"safety_value": 1}}
    assert drafted["command"] == {"throttle": throttle, "steering": "steering"}
    assert drafted["time"] == "vicon time"


def test_what_names_do_not_show_of_a_real_recording_is_blank_or_in_doubt(
    shared_recordings,
):
    file = shared_recordings / "differential_ticks" / "Camera_Odo_Data_01.txt"
    text, drafted = draft(file)
    assert text.splitlines()[0].endswith("add `unit: cm`")
    assert drafted["pose"] == {"x": "pose.x", "y": "pose.y", "heading": "pose.z"}
    assert drafted["command"] == {
        "left_wheel": {"from": "Left_Tick", "unit": "ticks"},
        "right_wheel": {"from": "Right_Tick", "unit": "ticks"},
    }
    assert text.count("guessed; add `ticks_per_turn:`") == 2
    assert "no command was recorded: the measured wheel motion is used instead" in text
    assert "\n#  or " not in text
    other, drafted = draft(file.with_name("Camera_Odo_Data_02.txt"))
    assert drafted["command"] is None  # the names of the wheels are missing
    assert "#  command_0: 13\n#  command_1: 14\n" in other
