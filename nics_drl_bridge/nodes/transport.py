"""Discovery and transport of the processes that this package starts; needs no ROS 2.

Messages go by UDP, so that a stalled listener can't block a publisher. Fast DDS's shared memory
has a lock for each listening process, and a listener that is frozen or killed while it holds the
lock blocks every sender. UDP has no lock; it makes a lock-step step 5 % longer.

If discovery stays on this machine, rmw_fastrtps chooses the transports itself. Then only a profile
can select UDP. Otherwise an environment variable is enough.
"""

import os
import sys
from collections.abc import Mapping, MutableMapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCAL = "LOCALHOST"
ONLY_LOCAL = "ROS_LOCALHOST_ONLY"
BY_PROFILE = "SYSTEM_DEFAULT"
# rcl treats any other value as LOCALHOST
OTHER_RANGES = ("SUBNET", "OFF", BY_PROFILE, "")
OLDEST_DISTRIBUTION = "humble"  # has no discovery ranges
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
UDP = "UDPv4"
PROFILE = Path(__file__).with_name("this_machine.xml")
# The variable in Fast DDS 3 and in Fast DDS 2, and files that it reads in the working folder.
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
PROFILES_HERE = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")
# kinds of discovery that the profile does not support
PEERS = ("ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS")
RMW = "RMW_IMPLEMENTATION"
FAST_DDS = "rmw_fastrtps_cpp"  # the default of every distribution
TABLE = Path("/proc/net/udp")
# RTPS: the first port of a domain is for multicast
FIRST_PORT = 7400
PORTS_OF_A_DOMAIN = 250
GREATEST_DOMAIN_ID = 232  # above it, DDS has no ports
# distributions whose robots expect a Twist
PLAIN_TWISTS = ("humble", "iron", "jazzy")


def is_before_kilted(distribution: str) -> bool:
    """True if a distribution, or the one of the wheels if it is empty, is older than Kilted."""
    if distribution:
        return distribution in PLAIN_TWISTS
    return any(map(_is_wheel, PLAIN_TWISTS))


def _is_wheel(name: str) -> bool:
    try:
        return bool(distribution(f"ros-{name}-rclpy"))
    except PackageNotFoundError:
        return False


def set_transport(environment: MutableMapping[str, str]) -> None:
    """Let DDS use UDP, on this machine unless a discovery range is set; change nothing chosen.

    Call it in a process of this package before its first node, and for its children.
    """
    distribution = environment.get("ROS_DISTRO", "")
    profile = PROFILES[is_before_kilted(distribution)]
    if environment.get(profile) == str(PROFILE):  # inherited
        if environment.get(RANGE) == BY_PROFILE:
            return
        del environment[profile]
    environment.setdefault(RANGE, LOCAL)
    if distribution == OLDEST_DISTRIBUTION:
        environment.setdefault(ONLY_LOCAL, "1")
    is_fast_dds = environment.get(RMW, FAST_DDS).startswith("rmw_fast")
    if sys.platform != "linux" or not is_fast_dds or has_chosen(environment):
        return
    has_range = distribution != OLDEST_DISTRIBUTION
    stays_here = has_range and environment[RANGE] not in OTHER_RANGES
    if not stays_here and environment.get(ONLY_LOCAL) != "1":
        environment[TRANSPORTS] = UDP
    elif not any(map(environment.get, PEERS)):
        environment.pop(ONLY_LOCAL, None)  # it would override the others
        environment[RANGE] = BY_PROFILE
        environment[profile] = str(PROFILE)


def has_chosen(environment: Mapping[str, str]) -> bool:
    """True if the user has chosen transports other than UDP, or Fast DDS profiles."""
    return (
        environment.get(TRANSPORTS, "") not in ("", UDP)
        or any(map(environment.get, PROFILES))
        or any(map(os.path.exists, PROFILES_HERE))
    )


def find_used_domains() -> set[int]:
    """Return the DDS domains with a participant on this machine."""
    if not TABLE.is_file():
        return set()
    rows = TABLE.read_text(encoding="ascii").splitlines()[1:]
    ports = {int(row.split()[1].split(":")[1], 16) for row in rows}
    return {
        (port - FIRST_PORT) // PORTS_OF_A_DOMAIN for port in ports if port >= FIRST_PORT
    }
