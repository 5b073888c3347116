"""What the planner commands, what a training learns, and what the estimator believes."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.generator import SimulatorModel, builtin_model
from nics_drl_bridge.middleware.middleware import Middleware
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.robot.noise import Level, Noise
from nics_drl_bridge.sim.simulator import FastSimulator
from nics_drl_bridge.sim.world import World

from .projection import Found, joined

PLANNED_ROBOTS = ("ackermann", "jackal")
PLANNED_STEPS = 60
TRAINING = {
    "worlds": {"arena": 16},
    "steps": 2048,
    "max_episode_steps": 40,
    "hidden": [16, 16],
    "ppo": {"rollout": 32, "batch": 256, "epochs": 2},
}
ESTIMATED_ROBOTS = ("ackermann", "differential")
ESTIMATED_PERIODS = 200
PERIOD_NS = 100_000_000
POSE_STD = np.array([0.02, 0.02, 0.02])  # of motion capture [m, m, rad]
GYRO_STD = 0.01  # [rad/s]
LOST = 0.1  # share of the messages that never arrive
DISPLACED_FROM = 100  # period from which motion capture sees the robot elsewhere
DISPLACEMENT = np.array([1.0, -1.0, 0.2])  # by so much [m, m, rad]
NOISE = Noise(
    odom_linear=Level(std=0.05, unit="m/s", source="measured"),
    odom_angular=Level(std=0.05, unit="rad/s", source="measured"),
    position_drift=Level(std=0.03, unit="m/sqrt(s)", source="measured"),
    heading_drift=Level(std=0.03, unit="rad/sqrt(s)", source="measured"),
)


def dynamic_window() -> Found:
    """The commands of the dynamic-window planner in worlds that it drives through."""
    found: Found = {}
    for robot in PLANNED_ROBOTS:
        model = builtin_model(robot)
        env = BridgeVectorEnv(4, model, "clutter", max_episode_steps=50)
        planner = make_policy("dynamic_window", env.task, model)
        observation, _ = env.reset(seed=11)
        arrays = []
        for _ in range(PLANNED_STEPS):
            action = planner.act(observation)
            arrays.append(action.copy())
            observation, _, _, _, _ = env.step(action)
        env.close()
        assert np.unique(np.concatenate(arrays), axis=0).shape[0] > 3
        found[robot] = joined(arrays)
    return found


def training() -> Found:
    """The weights of the actor, layer by layer, after a few updates of the lean engine."""
    from nics_drl_bridge.policy.train.run import train
    from nics_drl_bridge.policy.train.settings import (
        TrainingSettings,
        open_training,
    )

    settings = TrainingSettings.model_validate(TRAINING)
    with tempfile.TemporaryDirectory() as folder:
        actor = train(*open_training(settings), settings, 5, Path(folder)).algorithm
    return {
        f"layers.{k}.{name}": joined([weights])
        for k, layer in enumerate(actor.network.layers)
        for name, weights in layer._asdict().items()
    }


@dataclass(frozen=True)
class Message:
    """A message of a recorded drive."""

    arrival_ns: int
    stamp_ns: int
    topic: str  # "command", "odometry", "scan", "pose" or "imu"
    content: tuple[np.ndarray, ...]


def estimates() -> Found:
    """What the middleware believes along a recorded drive, by wheels alone and with more."""
    found: Found = {}
    for robot in ESTIMATED_ROBOTS:
        model = replace(builtin_model(robot), noise=NOISE)
        messages = record_messages(model, seed=12)
        odometry_alone = [
            each for each in messages if each.topic not in ("pose", "imu")
        ]
        found[f"{robot}, odometry alone"] = estimate(model, odometry_alone)
        found[f"{robot}, with poses and gyro"] = estimate(model, messages)
    return found


def record_messages(model: SimulatorModel, seed: int) -> list[Message]:
    """Records a random drive: messages in the order of arrival, each late, some of them lost."""
    rng = np.random.default_rng(seed)
    world = World.model_validate(
        {
            "name": "wide",
            "size": [200.0, 200.0],
            "clearance": 0.1,
            "goal_distance": [1.0, 3.0],
        }
    )
    simulator = FastSimulator(model, world, renderer="auto")
    simulator.reset([seed], starts=np.zeros((1, 1, 3)))
    data = simulator.data
    messages = []
    for period in range(ESTIMATED_PERIODS):
        if period % 5 == 0:
            command = rng.uniform(model.robot.command_low, model.robot.command_high)
        sent_ns = period * PERIOD_NS
        messages.append(Message(sent_ns, sent_ns, "command", (command,)))
        simulator.step(command[None, None])
        pose = data.pose[0, 0] + POSE_STD * rng.normal(size=3)
        if period >= DISPLACED_FROM:
            pose += DISPLACEMENT
        rate = data.twist[0, 0, 2] + GYRO_STD * rng.normal()
        contents = {
            "odometry": (data.odom[0, 0].copy(), data.twist[0, 0].copy()),
            "scan": (data.ranges[0, 0].copy(),),
            "pose": (pose, np.diag(POSE_STD**2)),
            "imu": (np.array(rate),),
        }
        stamp_ns = sent_ns + PERIOD_NS
        for topic, content in contents.items():
            late_ns = int(rng.uniform(0.0, 3.0 * PERIOD_NS))
            if rng.random() >= LOST:
                messages.append(Message(stamp_ns + late_ns, stamp_ns, topic, content))
    return sorted(messages, key=lambda message: message.arrival_ns)


def estimate(model: SimulatorModel, messages: list[Message]) -> list[float]:
    """Digest of views, of the ages in them and of covariances after each message."""
    middleware = Middleware(model)
    middleware.reset(0, np.zeros(3))
    arrays = []
    for message in messages:
        give(middleware, message)
        view = middleware.view(message.arrival_ns)
        covariance = middleware.estimator.covariance
        ages = [view.stamp_s, min(view.scan_age_s, 10.0), min(view.odom_age_s, 10.0)]
        arrays += [view.pose, view.twist, covariance.copy(), ages]
    return joined(arrays)


def give(middleware: Middleware, message: Message) -> None:
    """Gives a message to the middleware as its node does."""
    if message.topic == "command":
        middleware.command(message.stamp_ns, *message.content)
    elif message.topic == "imu":
        middleware.imu(message.stamp_ns, message.arrival_ns, float(message.content[0]))
    else:
        take = getattr(middleware, message.topic)
        take(message.stamp_ns, message.arrival_ns, *message.content)
