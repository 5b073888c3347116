"""Transport of messages: UDP, so that a stalled listener can't block a publisher.

Fast DDS's shared memory has a lock for each listening process. A listener that is frozen or killed
while it holds the lock blocks every sender. UDP has no lock; it makes a lock-step step 5 % longer.

If discovery stays on this machine, rmw_fastrtps chooses the transports itself. Then only a profile
can select UDP; Fast DDS reads it once per process, so the result is checked. A node that other code
creates afterwards may use shared memory. Otherwise an environment variable is enough, and remains.
"""

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from pathlib import Path

from rclpy.context import Context
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_rmw_implementation_identifier

from nics_drl_bridge.errors import BackendError

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCAL = "LOCALHOST"
ONLY_LOCAL = "ROS_LOCALHOST_ONLY"
SELF_MADE = "SYSTEM_DEFAULT"
# rcl treats any other value as LOCALHOST
OTHER_RANGES = ("SUBNET", "OFF", SELF_MADE, "")
OLDEST_DISTRIBUTION = "humble"  # has no discovery ranges
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
UDP = "UDPv4"
PROFILE = Path(__file__).with_name("this_machine.xml")
# The variable in Fast DDS 3 and in Fast DDS 2, and files that it reads in the working folder.
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
PROFILES_HERE = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")
FAST_DDS_2 = b"libfastrtps.so"
FAST_DDS_2_DISTRIBUTIONS = (OLDEST_DISTRIBUTION, "iron", "jazzy")
# kinds of discovery that the profile does not support
PEERS = ("ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS")
SEGMENTS = (b"shm/fastdds_", b"shm/fastrtps_")
TABLE = Path("/proc/net/udp")
# RTPS: the first port of a domain is for multicast
FIRST_PORT = 7400
PORTS_OF_A_DOMAIN = 250


def stays_here(environment: Mapping[str, str]) -> bool:
    """True if discovery stays on this machine, in an environment that sets its range."""
    if environment.get(ONLY_LOCAL) == "1":
        return True
    ranges = environment.get("ROS_DISTRO") != OLDEST_DISTRIBUTION
    return ranges and environment[RANGE] not in OTHER_RANGES


def chosen(environment: Mapping[str, str]) -> bool:
    """True if the user has chosen transports other than UDP, or Fast DDS profiles."""
    named = environment.get(TRANSPORTS, "") not in ("", UDP)
    return (
        named
        or any(map(environment.get, PROFILES))
        or any(map(os.path.exists, PROFILES_HERE))
    )


def stay_on_this_machine(environment: MutableMapping[str, str]) -> None:
    """Limit discovery to this machine in an environment that does not set its range."""
    environment.setdefault(RANGE, LOCAL)
    if environment.get("ROS_DISTRO") == OLDEST_DISTRIBUTION:
        environment.setdefault(ONLY_LOCAL, "1")


class Transport:
    """Transport of the nodes of this process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._in_force: bool | None = (
            None  # whether the profile applies; None: not tried yet
        )

    def open(self, make: Callable[[], Context]) -> Context:
        """Return a context over UDP if possible, else with ROS 2's default. Raises BackendError."""
        with self._lock:
            stay_on_this_machine(os.environ)
            here = stays_here(os.environ)
            if self._in_force and not here:
                earlier = "an earlier node in this process keeps its discovery on this machine"
                fix = "set it before the first, or use another process."
                raise BackendError(
                    f"{RANGE} is {os.environ[RANGE]}, but {earlier}; {fix}"
                )
            fast_dds = str(get_rmw_implementation_identifier()).startswith("rmw_fast")
            if sys.platform != "linux" or not fast_dds or chosen(os.environ):
                return make()
            if not here:
                os.environ[TRANSPORTS] = UDP
                return make()
            if self._in_force is False or any(map(os.environ.get, PEERS)):
                return make()
            return self._open_here(make)

    def _open_here(self, make: Callable[[], Context]) -> Context:
        words = {RANGE: SELF_MADE}
        if self._in_force is None:
            old = (
                os.environ.get("ROS_DISTRO") in FAST_DDS_2_DISTRIBUTIONS
                or FAST_DDS_2 in _maps()
            )
            words[PROFILES[old]] = str(PROFILE)
        with _changed(os.environ, words):
            context = make()
            if self._in_force is None:
                self._in_force = _is_in_force(context)
        if self._in_force:
            return context
        context.try_shutdown()
        why = "because a node was started in this process before, or discovery had a wider range"
        get_logger("nics_drl_bridge").warning(
            f"Fast DDS did not apply {PROFILE}, "
            f"{why if PROFILE.is_file() else 'which is missing'}: it sends through shared memory, "
            "and a process that is frozen or killed can hold this one up. Make the bridge's node "
            "or env first, or keep them in a process of their own."
        )
        return make()


@contextlib.contextmanager
def _changed(
    environment: MutableMapping[str, str], words: Mapping[str, str]
) -> Iterator[None]:
    # Without the older discovery variable, which would override the others.
    kept = {key: environment.pop(key, None) for key in (ONLY_LOCAL, *words)}
    environment.update(words)
    try:
        yield
    finally:
        for key, value in kept.items():
            environment.pop(key, None)
            environment.update({} if value is None else {key: value})


def _maps() -> bytes:
    return Path("/proc/self/maps").read_bytes()


def _is_in_force(context: Context) -> bool:
    try:
        node = Node(
            "transport_probe",
            context=context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[
                Parameter("start_type_description_service", value=False)
            ],
        )
    except BaseException:
        context.try_shutdown()
        raise
    try:
        shares = any(segment in _maps() for segment in SEGMENTS)
        return not shares and multicast_port(context.get_domain_id()) not in ports_of()
    finally:
        node.destroy_node()


OF_THIS_PROCESS = Transport()


def multicast_port(domain_id: int) -> int:
    """Return the port that participants bind to discover others beyond this machine."""
    return FIRST_PORT + PORTS_OF_A_DOMAIN * domain_id


def ports_of(process: int | str = "self") -> set[int]:
    """Return the IPv4 UDP ports that a process has bound, on Linux."""
    names = set()
    for file in Path(f"/proc/{process}/fd").iterdir():
        with contextlib.suppress(OSError):  # another thread has closed it
            names.add(os.readlink(file))
    return {port for name, port in _sockets() if name in names}


def domains_in_use() -> set[int]:
    """Return the DDS domains with a participant on this machine."""
    ports = {port for _, port in _sockets() if port >= FIRST_PORT}
    return {(port - FIRST_PORT) // PORTS_OF_A_DOMAIN for port in ports}


def _sockets() -> list[tuple[str, int]]:
    if TABLE.is_file():
        lines = TABLE.read_text(encoding="ascii").splitlines()[1:]
    else:
        lines = []
    rows = [line.split() for line in lines]
    return [(f"socket:[{row[9]}]", int(row[1].split(":")[1], 16)) for row in rows]
