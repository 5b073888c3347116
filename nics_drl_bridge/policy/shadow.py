"""Shadow mode: compares a policy's commands with those of a recorded drive."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nics_drl_bridge import defaults
from nics_drl_bridge.errors import ConfigError, RecordingError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import S_PER_NS, Array, RobotView
from nics_drl_bridge.middleware.measurement import CMD_VEL, ODOM, POSE, SCAN
from nics_drl_bridge.middleware.playback import Playback, merge_messages, read_messages
from nics_drl_bridge.pacing import ActionPace
from nics_drl_bridge.policy.file.stateful import resume
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.recording.messages import read_robot_command
from nics_drl_bridge.robot.spec import RobotSpec

JITTER = 0.25  # maximum earliness of a scan, in control periods
HELD_S = 1.0  # age at which a command no longer applies to the robot
DEAD_BAND = 0.05  # fraction of the maximum below which a command's sign is ignored
PERCENTILES = (50, 90, 99)


@dataclass(frozen=True)
class Shadow:
    """A policy compared with a recorded drive, at the T times when it would have acted."""

    names: tuple[str, ...]  # (C,) names of the commands
    units: tuple[str, ...]
    time: Array  # (T,) time since the first of these [s]
    pose: Array  # (T, 3) estimated poses in `map`
    goal: Array  # (T, 2) goals given to the policy [m]
    policy: Array  # (T, C) commands of the policy
    driven: Array  # (T, C) recorded commands
    scale: Array  # (C,) maximum magnitude of each command
    skipped: Mapping[str, int]  # reason -> number of times that were not compared
    resets: int = 0  # gaps after which the policy's state was reset

    def differences(self) -> dict[str, dict[str, float]]:
        """Returns per command statistics of policy minus drive, and the rate of opposite signs."""
        figures_by_command = {}
        for c, name in enumerate(self.names):
            wanted = self.policy[:, c]
            driven = self.driven[:, c]
            band = DEAD_BAND * self.scale[c]
            gap = wanted - driven
            size = np.abs(wanted - driven)
            signed = (np.abs(wanted) > band) & (np.abs(driven) > band)
            if signed.any():
                opposite = (wanted[signed] * driven[signed] < 0.0).mean()
            else:
                opposite = 0.0
            figures_by_command[name] = {
                "mean": float(gap.mean()),
                "mean_size": float(size.mean()),
                **{f"p{q}": float(np.percentile(size, q)) for q in PERCENTILES},
                "greatest": float(size.max()),
                "opposite": float(opposite),
            }
        return figures_by_command


@dataclass
class _Moment:
    receive_ns: int
    stamp_ns: int
    view: RobotView
    driven: Array | None = None


def shadow(
    path: str | Path,
    model: SimulatorModel,
    policy: str,
    topics: Mapping[str, str],
    goal: ArrayLike | None = None,
    ahead_s: float = defaults.SHADOW_AHEAD_S,
) -> Shadow:
    """Runs a policy on a recorded drive, in process and deterministically.

    The goal (2,) [m] is in `map`; None uses the robot's position `ahead_s` later. Raises
    RecordingError if the bag can't be used, another BridgeError if the policy can't.
    """
    if goal is None and not ahead_s > 0.0:
        raise ConfigError(f"--ahead {ahead_s:g}: must be more than 0 s.")
    messages = read_messages(path, topics, model.gyro)
    for role in (SCAN, CMD_VEL):
        if role not in messages:
            raise RecordingError(
                f"{path}: has no {role}, which the comparison needs; name its topic, for example "
                f"--topic {role}=/car/{role}."
            )
    playback = Playback(model, POSE in messages, any_lidar=True)
    moments = _find_moments(messages, playback, model)
    if not moments:
        raise RecordingError(
            f"{path}: no scan with matching odometry; see nics bag info."
        )
    if goal is None:
        goals = _find_later_places(moments, ahead_s)
    else:
        goals = np.broadcast_to(np.asarray(goal, np.float64), (len(moments), 2))
    return _compare_moments(
        moments, goals, policy, replace(model, lidar=playback.lidar)
    )


def _find_moments(
    messages: Mapping[str, Any], playback: Playback, model: SimulatorModel
) -> list[_Moment]:
    """Plays messages by role; returns the times at which the policy would have acted."""
    pace = ActionPace(model.control_period)
    moments = list[_Moment]()
    held: tuple[int, Array] | None = None
    acted_ns = 0
    for role, message in merge_messages(messages):
        playback.take(role, message.receive_ns, message.content)
        if role == CMD_VEL:
            row = read_robot_command(message.content, model.robot)
            held = message.receive_ns, row
            if moments and moments[-1].driven is None:
                moments[-1].driven = row
        newest = playback.middleware.cache.newest
        if role not in (SCAN, ODOM) or SCAN not in newest or ODOM not in newest:
            continue
        scan_ns = newest[SCAN].stamp_ns
        scan_s = scan_ns * S_PER_NS
        early = pace.get_wait(scan_s + JITTER * model.control_period) > 0.0
        if newest[ODOM].stamp_ns < scan_ns or scan_ns <= acted_ns or early:
            continue
        pace.acted(scan_s)
        acted_ns = scan_ns
        _hold(moments, held)
        view = playback.middleware.view(playback.middleware.newest_ns or scan_ns)
        moments.append(_Moment(message.receive_ns, scan_ns, view))
    _hold(moments, held)
    return moments


def _find_later_places(moments: list[_Moment], ahead_s: float) -> Array:
    """Returns where the robot was `ahead_s` after each moment (T, 2) [m]."""
    times = np.array([moment.stamp_ns for moment in moments]) * S_PER_NS
    places = np.array([moment.view.pose[:2] for moment in moments])
    later = [np.interp(times + ahead_s, times, place) for place in places.T]
    return np.stack(later, axis=-1)


def _hold(moments: list[_Moment], held: tuple[int, Array] | None) -> None:
    if moments and moments[-1].driven is None and held is not None:
        age_s = (moments[-1].receive_ns - held[0]) * S_PER_NS
        moments[-1].driven = held[1] if age_s <= HELD_S else None


def _compare_moments(
    moments: list[_Moment], goals: Array, name: str, model: SimulatorModel
) -> Shadow:
    policy, task = open_policy(name, model)
    robot = model.robot
    rows = list[tuple[Any, ...]]()
    resets = 0
    skipped = {"no command was driven": 0, "at the goal": 0, "touching something": 0}
    for moment, goal in zip(moments, goals, strict=True):
        memory = {"goal": goal}
        verdict = task.judge(moment.view, memory)
        # A state also needs the observations that are not compared.
        if not (verdict.touched or verdict.reached):
            resets += bool(resume(policy, moment.stamp_ns * S_PER_NS))
            command = task.command(policy.act(task.observation(moment.view, memory)))
        if moment.driven is None:
            skipped["no command was driven"] += 1
        elif verdict.touched:
            skipped["touching something"] += 1
        elif verdict.reached:
            skipped["at the goal"] += 1
        else:
            wanted = robot.pass_through_cmd_vel(command)
            rows.append(
                (moment.stamp_ns, moment.view.pose, goal, wanted, moment.driven)
            )
    if not rows:
        counts = [f"{skipped[why]} times {why}" for why in skipped if skipped[why]]
        raise RecordingError(
            f"nothing to compare: {', '.join(counts)}; choose another goal."
        )
    return _make_shadow(robot, rows, skipped, resets)


def _make_shadow(
    robot: RobotSpec, rows: list[tuple[Any, ...]], skipped: dict[str, int], resets: int
) -> Shadow:
    """Returns the comparison of rows: stamp, pose, goal, command of the policy, driven command."""
    stamps, poses, goals, wanted, driven = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return Shadow(
        tuple(command.name for command in robot.command),
        tuple(command.unit for command in robot.command),
        (stamps - stamps[0]) * S_PER_NS,
        poses,
        goals,
        wanted,
        driven,
        np.maximum(np.abs(robot.command_low), np.abs(robot.command_high)),
        skipped,
        resets,
    )
