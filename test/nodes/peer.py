"""The test's own end of the topics: a node in a context of its own."""

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import LaserScan

from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.nodes import conversions, qos
from nics_drl_bridge.nodes.listener import SpunNode

DEADLINE_S = 90.0
# Fast DDS drops an answer whose client the server has not discovered within 0.1 s.
ANSWERED_S = 15.0
NUMBERS = itertools.count()


class Peer:
    """Listens, publishes and calls services; spins in place while it waits for a condition."""

    def __init__(self, domain_id: int, namespace: str = "") -> None:
        self._spun = SpunNode(f"peer_{next(NUMBERS)}", domain_id, namespace)
        self.node = self._spun.node
        self.close = self._spun.close

    def within(self, seconds: float, condition: Callable[[], Any]) -> bool:
        """Spin until a condition holds or the time is over; return whether it holds."""
        return self._spun.until(condition, seconds)

    def until(
        self, condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S
    ) -> float:
        """Spin until a condition holds; return how long that took [s]."""
        began = time.monotonic()
        is_met = self.within(deadline_s, condition)
        assert is_met, f"not within {deadline_s} s: {what}"
        return time.monotonic() - began

    def another(self, messages: list[Any], what: str) -> Any:
        """Return the next message in a list that `listen` returned."""
        known = len(messages)
        self.until(lambda: len(messages) > known, f"another {what}")
        return messages[-1]

    def listen(
        self, kind: Any, topic: str, quality: Any = qos.SENSOR_RELIABLE
    ) -> list[Any]:
        """Return a list to which each message of a topic is appended."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, quality)
        return received

    def speak(
        self, kind: Any, topic: str, subscribers: int = 1, quality: Any = qos.COMMAND
    ) -> Any:
        """Return a publisher once the given number of subscribers have found it."""
        publisher = self.node.create_publisher(kind, topic, quality)
        self.until(
            lambda: publisher.get_subscription_count() >= subscribers,
            f"a subscriber of {topic}",
        )
        return publisher

    def call(
        self,
        kind: Any,
        service: str,
        request: Any = None,
        retry_period_s: float = ANSWERED_S,
    ) -> Any:
        """Return the answer of a service; ask again if none comes."""
        asked = kind.Request() if request is None else request
        return self._spun.call_service(kind, service, DEADLINE_S, asked, retry_period_s)

    def read_episode(self, simulator: str = "simulator_node") -> dict[str, str]:
        """Return the facts of a simulator about the present episode."""
        (status,) = self.call(SelfTest, f"{simulator}/self_test").status
        return {pair.key: pair.value for pair in status.values}

    def be_known_to(self, node: str) -> None:
        """Wait until a node has discovered all subscriptions of this peer.

        Subscriptions are announced in order, and that of the answer comes last.
        """
        self.call(GetParameters, f"{node}/get_parameters")


def stamp_ns(message: Any) -> int:
    return conversions.stamp_from_ros(message.header.stamp)


def pose_of(odometry: Odometry) -> np.ndarray:
    """Return the pose (3,) of an odometry."""
    return conversions.odometry_from_ros(odometry)[0]


def odometry(
    stamp: int, pose: ArrayLike = (0.0, 0.0, 0.0), twist: ArrayLike = (0.0, 0.0, 0.0)
) -> Odometry:
    """Return the odometry of a robot, by default at rest at its origin."""
    frames = ("odom", "base_link")
    return conversions.odometry_to_ros(pose, twist, stamp, frames, (1e-4,) * 4)


def scan(
    lidar: LidarSpec, stamp: int, ranges: ArrayLike = 2.0, beams: int | None = None
) -> LaserScan:
    """Return a scan of a lidar [m], by default of a round room."""
    seen = np.full(beams or lidar.beams, ranges, np.float32)
    return conversions.scan_to_ros(lidar, seen, stamp, "laser")


class PlayedRobot:
    """Odometry, scans and poses of a robot that the test plays."""

    def __init__(self, peer: Peer, lidar: LidarSpec) -> None:
        self.peer = peer
        self._lidar = lidar
        publish = partial(peer.node.create_publisher, qos_profile=qos.SENSOR_RELIABLE)
        self._odom = publish(Odometry, "odom")
        self._scan = publish(LaserScan, "scan")
        self._pose = publish(PoseStamped, "pose")
        self._stamps = itertools.count(10**9, 10**8)

    def send(
        self,
        pose: ArrayLike = (0.0, 0.0, 0.0),
        twist: ArrayLike = (0.0, 0.0, 0.0),
        stamp: int | None = None,
        scans: bool = True,
    ) -> int:
        """Publish the data of a stamp [ns], by default 0.1 s after the last; return it."""
        stamp = next(self._stamps) if stamp is None else stamp
        self._odom.publish(odometry(stamp, pose, twist))
        if scans:
            self._scan.publish(scan(self._lidar, stamp))
        self._pose.publish(conversions.pose_to_ros(pose, stamp, "map"))
        return stamp


def drive_alike(here, there, seeds=(3, 4), steps=8) -> None:
    """Drive two envs by the same random commands; all that they tell must be bit-identical."""
    told = []
    for env in (here, there):
        rng = np.random.default_rng(0)
        told.append([])
        for seed in seeds:
            told[-1].append(env.reset(seed=seed))
            for _ in range(steps):
                action = rng.uniform(-1.0, 1.0, env.action_space.shape)
                seen, reward, ended, _, info = env.step(action.astype(np.float32))
                told[-1].append((seen, info | {"reward": reward, "ended": ended}))
    for (seen, info), (seen_there, info_there) in zip(*told, strict=True):
        assert np.array_equal(seen, seen_there)
        for key in {"reward", "ended", "pose", "covariance", "start"} & info.keys():
            assert np.array_equal(info[key], info_there[key]), key
        if "true_pose" in info_there:  # a quaternion rounds the heading
            assert np.abs(info["true_pose"] - info_there["true_pose"]).max() < 1e-12
    assert np.array_equal(here.scene.bodies, there.scene.bodies)
