"""Facts about a robot, live or from a bag, and the doctor's expectations and findings."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge import defaults
from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import NS_PER_S
from nics_drl_bridge.lidar.sectors import ScanLayout, make_reader, make_sector_plan
from nics_drl_bridge.lidar.spec import LidarSpec, ScanHeader
from nics_drl_bridge.policy.file.contract import Contract
from nics_drl_bridge.recording import messages
from nics_drl_bridge.recording.bag_file import is_bag, open_bag
from nics_drl_bridge.recording.imu_axis import GyroReader
from nics_drl_bridge.recording.messages import Offer, Row
from nics_drl_bridge.recording.topic_roles import IMU, IMU_NAMES, list_imu_topics
from nics_drl_bridge.robot.spec import RobotSpec

SCAN = "scan"
ODOM = "odom"
CMD_VEL = "cmd_vel"
CLOCK = "/clock"
GYRO = "imu"
TWIST_STAMPED_TYPE = "geometry_msgs/msg/TwistStamped"
KINDS: dict[str, Sequence[str]] = {  # message types of each role; others are not read
    SCAN: ("sensor_msgs/msg/LaserScan",),
    ODOM: ("nav_msgs/msg/Odometry",),
    CMD_VEL: ("geometry_msgs/msg/Twist", TWIST_STAMPED_TYPE),
    CLOCK: ("rosgraph_msgs/msg/Clock",),
    GYRO: (IMU,),
}
MOST_SCANS = 200  # maximum number of scans whose ranges are kept
MOST_RAD = 7.0  # larger angles are in degrees [rad]


@dataclass(frozen=True)
class Endpoints:
    """Publishers and subscribers of a topic, without the doctor's own."""

    types: tuple[str, ...]  # message types that the publishers declare
    offers: tuple[Offer, ...] = ()  # quality of service of each publisher
    asks: tuple[Offer, ...] = ()  # quality of service of each subscriber


@dataclass
class TopicFacts:
    """Arrival times, stamps and frames of a topic's messages."""

    arrivals_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    frames: set[str] = field(default_factory=set)
    children: set[str] = field(default_factory=set)


class Layout(NamedTuple):
    """The beams of a scan according to its header, without its times."""

    beams: int
    header: ScanHeader

    @property
    def last(self) -> float:
        """Angle of the last beam according to the increment [rad]."""
        return self.header.angle_min + (self.beams - 1) * self.header.angle_increment

    @property
    def in_degrees(self) -> bool:
        """True if the angles are too large for radians."""
        return max(abs(self.header.angle_min), abs(self.header.angle_max)) > MOST_RAD


@dataclass
class Facts:
    """What was observed of a robot; a role is `scan`, `odom`, `cmd_vel`, `imu` or `/clock`."""

    source: str
    live: bool  # True over DDS, False from a bag
    names: dict[str, str]  # role -> topic
    topics: dict[str, Endpoints] = field(default_factory=dict)  # by topic
    heard: dict[str, TopicFacts] = field(default_factory=dict)  # by role
    end_ns: int = 0  # end of listening, on the clock of arrivals [ns]
    layouts: list[Layout] = field(default_factory=list)  # distinct layouts of the scans
    # ranges of the first `MOST_SCANS` scans [m]
    ranges: list[NDArray[np.float32]] = field(default_factory=list)
    # poses of odometry: x, y [m], heading [rad]
    poses: list[Row] = field(default_factory=list)
    # twists of odometry: vx, vy [m/s], wz [rad/s]
    twists: list[Row] = field(default_factory=list)
    lengths: list[float] = field(
        default_factory=list
    )  # norms of odometry's quaternions
    # number of odometry messages whose covariance of pose or twist is all zeros
    uncovered: int = 0
    commands: list[Row] = field(default_factory=list)  # vx, vy [m/s], wz [rad/s]
    clock_ns: list[int] = field(default_factory=list)  # times on `/clock` [ns]
    gyro: GyroReader = field(default_factory=GyroReader)
    # stamps [ns] and yaw rates [rad/s] of the gyro
    yaw_rates: list[tuple[int, float]] = field(default_factory=list)

    def take(self, role: str, arrival_ns: int, message: Any) -> None:
        """Records a message from ROS or from a bag; both have the same fields."""
        heard = self.heard.setdefault(role, TopicFacts())
        heard.arrivals_ns.append(arrival_ns)
        if hasattr(message, "header"):
            heard.stamps_ns.append(messages.get_stamp(message))
            heard.frames.add(str(message.header.frame_id))
        if role == SCAN:
            fields = {
                name: float(getattr(message, name)) for name in ScanHeader._fields
            }
            header = ScanHeader(**fields)._replace(time_increment=0.0, scan_time=0.0)
            layout = Layout(len(message.ranges), header)
            if layout not in self.layouts:
                self.layouts.append(layout)
            if len(self.ranges) < MOST_SCANS:
                self.ranges.append(np.array(message.ranges, dtype=np.float32))
        elif role == ODOM:
            heard.children.add(str(message.child_frame_id))
            self.poses.append(messages.read_pose(message))
            self.twists.append(messages.read_twist(message))
            self.lengths.append(math.hypot(*messages.read_quaternion(message)))
            covariances = message.pose.covariance, message.twist.covariance
            self.uncovered += any(not np.any(covariance) for covariance in covariances)
        elif role == CMD_VEL:
            self.commands.append(messages.read_command(message))
        elif role == GYRO:
            measured = self.gyro.read(message)
            if measured is not None:
                self.yaw_rates.append((messages.get_stamp(message), measured[0]))
        else:
            self.clock_ns.append(
                int(message.clock.sec) * NS_PER_S + int(message.clock.nanosec)
            )


def names_in(namespace: str, imu: str = defaults.IMU_TOPIC) -> dict[str, str]:
    """Returns the topic of each role for a robot in a namespace; no gyro if `imu` is `none`."""
    space = parse_namespace(namespace)
    names = {role: f"{space}/{role}" for role in (SCAN, ODOM, CMD_VEL)} | {CLOCK: CLOCK}
    gyros = list_imu_topics(imu, by_default=True)
    if gyros:
        name = gyros[0]
        if not name.startswith("/"):
            name = f"{space}/{name}"
        names[GYRO] = name
    return names


def name_of_gyro(
    names: Mapping[str, str], imu: str, types: Mapping[str, Sequence[str]]
) -> str:
    """Returns the gyro's topic: the one the user named, else one that carries `Imu` messages.

    Topics of the robot's namespace come first. Without any, it is the default one.
    """
    usual = names[GYRO]
    if imu != defaults.IMU_TOPIC or IMU in types.get(usual, ()):
        return usual
    space = usual.removesuffix(GYRO)
    gyros = sorted(name for name, kinds in types.items() if IMU in kinds)
    nearby = [name for name in gyros if name.startswith(space)]
    second = f"{space}{IMU_NAMES[1]}"
    return second if second in nearby else next(iter(nearby), usual)


def collect_facts_of_bag(
    path: str | Path, namespace: str = "", imu: str = defaults.IMU_TOPIC
) -> Facts:
    """Collects the facts of a robot from a bag. Raises RecordingError if that fails."""
    if Path(path).exists() and not is_bag(path):
        advice = f"for another recording run `nics inspect {path}`"
        raise RecordingError(
            f"{path}: is not a bag; nics doctor checks bags and live robots; {advice}."
        )
    facts = Facts(str(path), False, names_in(namespace, imu))
    with open_bag(path) as bag:
        if GYRO in facts.names:
            types = {topic: kind.split(" and ") for topic, kind in bag.types.items()}
            facts.names[GYRO] = name_of_gyro(facts.names, imu, types)
        facts.end_ns = bag.span_ns[1]
        for topic, kind in bag.types.items():
            facts.topics[topic] = Endpoints(
                tuple(kind.split(" and ")), bag.offers(topic)
            )
        for role, topic in facts.names.items():
            if bag.types.get(topic) in KINDS[role]:
                for message in bag.read_messages(topic):
                    try:
                        facts.take(role, message.receive_ns, message.content)
                    except AttributeError as error:  # the bag has its own definition
                        fault = f"topic {topic!r} is not a standard {bag.types[topic]}"
                        raise RecordingError(
                            f"{path}: {fault}: it lacks the field {error.name!r}."
                        ) from None
    return facts


@dataclass(frozen=True)
class Mismatch:
    """A mismatch with its fix; an `error` makes a policy misbehave, a `warning` may do so."""

    severity: Literal["error", "warning"]
    check: str
    where: str
    what: str
    fix: str


@dataclass(frozen=True)
class Expected:
    """What a model or policy expects of a robot."""

    robot: RobotSpec
    lidar: LidarSpec
    period_s: float  # time between commands
    # sectors that any lidar may fill; None: the beams must be exactly those of `lidar`
    scan: ScanLayout | None = None
    gyro: bool = False  # True if the model was identified with a gyro


def derive_expected(
    source: SimulatorModel | Contract, scan: ScanLayout | None = None
) -> Expected:
    """Returns the expectations of a model, or of a policy file with the sectors of its scan."""
    gyro = getattr(source, "gyro", False)
    return Expected(source.robot, source.lidar, source.control_period, scan, gyro)


def expect_present_lidar(facts: Facts, expected: Expected) -> Expected:
    """Replaces the expected lidar by the robot's own if that fills the required sectors."""
    if expected.scan is None or not facts.layouts:
        return expected
    try:
        lidar = fit_lidar_to_header(facts.layouts[0], expected.lidar, expected.scan)
    except ConfigError:
        return expected
    return replace(expected, lidar=lidar)


def fit_lidar_to_header(
    layout: Layout, mounted: LidarSpec, scan: ScanLayout
) -> LidarSpec:
    """Returns the lidar that a scan header describes, at the place of `mounted`.

    Raises ConfigError if it does not fill the sectors of `scan`.
    """
    lidar = make_reader(layout.header, layout.beams, mounted).lidar
    make_sector_plan(lidar, scan)
    return lidar
