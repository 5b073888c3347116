"""A program without ROS 2 that drives a simulator: `other_client.py LIBRARY DOMAIN`.

It prints what it read before it drove and after: beams of the scan, and the range ahead [m].
"""

import json
import os
import sys
import time
from dataclasses import dataclass

PATIENCE_S = 20.0
SPEED = 0.3
NEARER_M = 0.5
FAR_M = 99.0
CYCLONE = """<CycloneDDS><Domain><General><Interfaces>
<NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><Peers><Peer address="127.0.0.1"/></Peers>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
</Discovery><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""


def drive(read, write) -> None:
    """Reads a scan, and commands after each one until what is ahead is nearer, or time is up."""
    ranges = read()
    before = after = ahead(ranges)
    end = time.monotonic() + PATIENCE_S
    while after > before - NEARER_M and time.monotonic() < end:
        write()
        after = ahead(read())
    print(json.dumps({"beams": len(ranges), "ahead": [before, after]}))


def ahead(ranges) -> float:
    """The range of the middle beam [m]."""
    return min(ranges[len(ranges) // 2], FAR_M)


def rosless(domain: int) -> None:
    import rosless as library

    with (
        library.subscribe("/scan", domain=domain, wait=PATIENCE_S) as scans,
        library.advertise(
            "/cmd_vel", "geometry_msgs/msg/Twist", domain=domain
        ) as commands,
    ):
        drive(
            lambda: scans.read(timeout=PATIENCE_S).ranges,
            lambda: commands.send({"linear": {"x": SPEED}}),
        )


def cyclonedds(domain: int) -> None:
    os.environ["CYCLONEDDS_URI"] = CYCLONE
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    participant = DomainParticipant(domain)
    best = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    reliable = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)))
    reader = DataReader(participant, Topic(participant, "rt/scan", LaserScan), best)
    writer = DataWriter(participant, Topic(participant, "rt/cmd_vel", Twist), reliable)

    def read():
        scan = next(reader.take_iter(timeout=duration(seconds=PATIENCE_S)), None)
        if scan is None:
            raise SystemExit("no scan")
        return scan.ranges

    forwards = Twist(Vector3(SPEED, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))
    drive(read, lambda: writer.write(forwards))


if sys.argv[1] == "cyclonedds":
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import float32, float64, int32, sequence, uint32

    @dataclass
    class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
        sec: int32
        nanosec: uint32

    @dataclass
    class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
        stamp: Time
        frame_id: str

    @dataclass
    class LaserScan(IdlStruct, typename="sensor_msgs::msg::dds_::LaserScan_"):
        header: Header
        angle_min: float32
        angle_max: float32
        angle_increment: float32
        time_increment: float32
        scan_time: float32
        range_min: float32
        range_max: float32
        ranges: sequence[float32]
        intensities: sequence[float32]

    @dataclass
    class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
        x: float64
        y: float64
        z: float64

    @dataclass
    class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
        linear: Vector3
        angular: Vector3


if __name__ == "__main__":
    clients = {"rosless": rosless, "cyclonedds": cyclonedds}
    clients[sys.argv[1]](int(sys.argv[2]))
