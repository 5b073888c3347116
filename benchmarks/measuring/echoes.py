"""A bare pair of nodes that exchange messages, and an env that steps in lock-step over topics.

python -m measuring.echoes NAMESPACE near|far
"""

import array
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium
import numpy as np
from bench import SCRIPTS
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from measuring.evaluations import standing_action
from measuring.peers import WORLD
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.env.registry import NAVIGATION, register_envs
from nics_drl_bridge.nodes.processes import NodeProcess, choose_domain_id

ROBOT = "ackermann"
BEAMS = 720
DEPTH = 10
PATIENCE_S = 60.0
REST_S = 0.003
Exchange = Callable[[], Callable[[], object] | None]
Chunk = Callable[[int], list[float]]


class Bare:
    """One node and an executor, in a process that has nothing else."""

    def __init__(self, name: str, namespace: str) -> None:
        context = Context()
        context.init(None)
        self.node = Node(
            name, namespace=namespace, context=context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def spin_until(self, done: Callable[[], bool]) -> None:
        """Spins in place. Raises TimeoutError."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError("the bare pair does not answer")
            self._executor.spin_once(timeout_sec=1.0)


def run_far_end(namespace: str) -> None:
    """Answers each Twist by an Odometry and a LaserScan, until its parent is gone."""
    end = Bare("far_end", namespace)
    parent = os.getppid()
    odometry, scan = Odometry(), LaserScan()
    scan.ranges = array.array("f", [1.0] * BEAMS)
    odometry_topic = end.node.create_publisher(Odometry, "odom", DEPTH)
    scan_topic = end.node.create_publisher(LaserScan, "scan", DEPTH)

    def echo(_: Twist) -> None:
        odometry_topic.publish(odometry)
        scan_topic.publish(scan)

    end.node.create_subscription(Twist, "cmd_vel", echo, DEPTH)
    while os.getppid() == parent:
        end._executor.spin_once(timeout_sec=1.0)


def run_near_end(namespace: str) -> None:
    """Makes as many round trips as each line on standard input says, and prints their seconds."""
    end = Bare("near_end", namespace)
    received: list[object] = []
    end.node.create_subscription(Odometry, "odom", received.append, DEPTH)
    end.node.create_subscription(LaserScan, "scan", received.append, DEPTH)
    commands = end.node.create_publisher(Twist, "cmd_vel", DEPTH)
    names = [end.node.resolve_topic_name(topic) for topic in ("odom", "scan")]
    end.spin_until(
        lambda: (
            commands.get_subscription_count() > 0
            and all(end.node.count_publishers(name) > 0 for name in names)
        )
    )
    command = Twist()

    def exchange() -> None:
        received.clear()
        commands.publish(command)
        end.spin_until(lambda: len(received) >= 2)

    time.sleep(
        1.0
    )  # the first answers may be lost, while the far end does not yet know of it
    for line in sys.stdin:
        sys.stdout.write(json.dumps(time_each(exchange, int(line))) + "\n")
        sys.stdout.flush()


ENDS = {"far": run_far_end, "near": run_near_end}


@contextmanager
def open_echo(domain_id: int) -> Iterator[Chunk]:
    """A function that makes round trips between two processes, as ROS 2 makes them by itself."""
    namespace = f"bare_{os.getpid()}"
    order = [sys.executable, "-m", "measuring.echoes", namespace]
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"} | os.environ
    environment["ROS_DOMAIN_ID"] = str(domain_id)
    with (
        subprocess.Popen([*order, "far"], env=environment, cwd=SCRIPTS) as far,
        subprocess.Popen(
            [*order, "near"],
            env=environment,
            cwd=SCRIPTS,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as near,
    ):

        def echo(count: int) -> list[float]:
            near.stdin.write(f"{count}\n")
            near.stdin.flush()
            if not (answer := near.stdout.readline()):
                raise TimeoutError("the bare pair does not answer")
            return json.loads(answer)

        try:
            yield echo
        finally:
            near.terminate()
            far.terminate()


class Driving:
    """Steps an env by random actions, and adds up how far its robot drives.

    Args:
        env: that has been reset.
        control: `slow`, `standing` or None.

    Attributes:
        driven_m: by the robot's own estimate [m].
    """

    def __init__(self, env: gymnasium.Env, control: str | None) -> None:
        self._env = env
        self._actions = np.random.default_rng(0)
        self._stands = control == "standing"
        self._rest_s = REST_S if control == "slow" else 0.0
        self.driven_m = 0.0
        self._pose = None

    def step(self) -> Callable[[], object] | None:
        """One step; gives what begins a new episode where one has ended."""
        action = self._actions.uniform(-1.0, 1.0, self._env.action_space.shape).astype(
            np.float32
        )
        if self._stands:
            action = standing_action(self._env)
        _, _, ended, cut, info = self._env.step(action)
        before = self._pose
        self._pose = info["pose"]
        if before is not None:
            self.driven_m += float(np.hypot(*(self._pose - before)[:2]))
        if self._rest_s:
            time.sleep(self._rest_s)
        return self._begin if ended or cut else None

    def _begin(self) -> None:
        self._env.reset()
        self._pose = None


@contextmanager
def open_env(domain_id: int, folder: Path, control: str | None) -> Iterator[Driving]:
    """An env that drives in lock-step with a simulator in a process of its own."""
    register_envs()
    file = folder / "world.yaml"
    file.write_text(dump_yaml(WORLD.model_dump(mode="json")))
    parameters = {"model": ROBOT, "world": str(file), "mode": "lockstep"}
    namespace = f"lockstep_{os.getpid()}"  # whoever else may be in that domain
    with NodeProcess("simulator_node", folder, parameters, domain_id, namespace):
        options = {
            "domain_id": domain_id,
            "namespace": namespace,
            "timeout_s": PATIENCE_S,
        }
        env = gymnasium.make(
            NAVIGATION,
            backend="dds",
            model=ROBOT,
            world=str(file),
            backend_options=options,
        )
        env.reset(seed=0)
        yield Driving(env, control)
        env.close()


def time_each(exchange: Exchange, count: int) -> list[float]:
    """Seconds of each of so many exchanges; what one gives to be called after it is not timed."""
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        afterwards = exchange()
        times.append(time.perf_counter() - begin)
        if afterwards is not None:
            afterwards()
    return times


def measure_in_turns(chunks: int, size: int, control: str | None) -> dict[str, float]:
    """Returns steps and echoes per second over all chunks, and how long a step takes."""
    domain_id = choose_domain_id()
    with (
        tempfile.TemporaryDirectory() as folder,
        open_env(domain_id, Path(folder), control) as driving,
        open_echo(domain_id) as echo,
    ):
        time_each(driving.step, size)  # as warm as they get
        echo(size)
        steps = []
        echoes = []
        for _ in range(chunks):
            steps += time_each(driving.step, size)
            echoes += echo(size)
    rate = len(steps) / sum(steps)
    bare = len(echoes) / sum(echoes)
    p50, p99 = np.quantile(steps, [0.5, 0.99]) * 1e3
    return {
        "steps_per_s": round(rate, 1),
        "bare_echo_per_s": round(bare, 1),
        "ratio": round(rate / bare, 3),
        "p50_ms": round(float(p50), 3),
        "p99_ms": round(float(p99), 3),
        "driven_m": round(driving.driven_m, 3),
    }


if __name__ == "__main__":
    ENDS[sys.argv[2]](sys.argv[1])
