"""What messages travel by: UDP, so that nobody who stands still holds up who publishes.

Fast DDS's shared memory has a lock for each process that listens. One that is frozen, or killed,
while it holds the lock holds up everybody who sends to it, for as long as it stands still: a gate
that tells the base to stop, a base that sends its odometry to a policy. UDP has no such lock, and
a step in lock-step takes a twentieth longer. A process of these nodes has no shared memory, neither
to send through nor to be sent to, so that drivers that have it aren't held up by them either.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, MutableMapping
from pathlib import Path

from rclpy.context import Context
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier

RANGE, LOCAL, SELF_MADE = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST", "SYSTEM_DEFAULT"
TRANSPORTS, UDP = "FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"
PROFILE = Path(__file__).with_name("this_machine.xml")
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Names of the same variable, of Fast DDS 3 and of Fast DDS 2, which the library's name tells."""
FAST_DDS_2 = "libfastrtps.so"
FAST_DDS_2_DISTRIBUTIONS = ("humble", "iron", "jazzy")
CHOICES = (*PROFILES, "ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY")
"""Who sets one of these has chosen, as has who names other transports than UDP. `LOCALHOST_ONLY` is
older than ranges and overrules them."""
SEGMENTS = ("shm/fastdds_", "shm/fastrtps_")
MAPS = Path("/proc/self/maps")


def prefer_udp(environment: MutableMapping[str, str], profiles: str = PROFILES[0]) -> None:
    """Turns Fast DDS's shared memory off in an environment that does not choose for itself.

    For LOCALHOST, rmw_fastrtps chooses the transports itself; so the range becomes SYSTEM_DEFAULT,
    and a profile does what LOCALHOST does, but for the shared memory.

    Args:
        environment: of the process, whose range is set.
        profiles: name of the variable of the profiles' file.
    """
    inherited = Path(environment.get(profiles, "")).parts[-3:] == PROFILE.parts[-3:]
    if inherited:
        del environment[profiles]
    chosen = any(environment.get(name) for name in CHOICES)
    if chosen or environment.get(TRANSPORTS, UDP) != UDP:
        return
    if environment[RANGE] == LOCAL or (inherited and environment[RANGE] == SELF_MADE):
        environment[RANGE], environment[profiles] = SELF_MADE, str(PROFILE)
    else:
        environment[TRANSPORTS] = UDP


class Transport:
    """How this process sends; profiles of Fast DDS are read once in it, with its first node."""

    def __init__(self) -> None:
        self._lock, self._tried, self._vain = threading.Lock(), False, False

    def open(self, make: Callable[[], Context]) -> Context:
        """A context over UDP; as rmw_fastrtps makes it where that can't be had.

        It can't where a node of somebody else was started in this process before: that is warned
        of, once.

        Args:
            make: makes a context in the environment of this process.
        """
        with self._lock:
            if self._vain or not _is_fast_dds():
                return make()
            profiles = _profiles_variable(os.environ.get("ROS_DISTRO"))
            prefer_udp(os.environ, profiles)
            context = make()
            if self._tried or profiles not in os.environ or not _shares_memory(context):
                self._tried = True
                return context
            self._vain = True
            context.try_shutdown()
            os.environ[RANGE] = LOCAL
            del os.environ[profiles]
            get_logger("nics_drl_bridge").warning(
                "a node was started in this process before, with Fast DDS's shared memory: a "
                "process that is frozen or killed can hold this one up. Make the bridge's node or "
                "env first, or keep them in a process of their own."
            )
            return make()


def _is_fast_dds() -> bool:
    """Whether it is known what to do here: Fast DDS on Linux."""
    name = str(get_rmw_implementation_identifier())
    return sys.platform == "linux" and name.startswith("rmw_fast")


def _profiles_variable(distribution: str | None) -> str:
    """Name of the variable of the profiles' file in this process."""
    old = distribution in FAST_DDS_2_DISTRIBUTIONS
    return PROFILES[old or FAST_DDS_2 in MAPS.read_text(encoding="utf-8")]


def _shares_memory(context: Context) -> bool:
    """Whether a node in a context has shared memory of Fast DDS."""
    node = Node(
        "transport_probe",
        context=context,
        use_global_arguments=False,
        start_parameter_services=False,
        enable_rosout=False,
    )
    try:
        maps = MAPS.read_text(encoding="utf-8")
        return any(segment in maps for segment in SEGMENTS)
    finally:
        node.destroy_node()


OF_THIS_PROCESS = Transport()
