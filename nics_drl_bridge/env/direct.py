"""Fast steps of one robot, computed directly on the simulator's arrays."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nics_drl_bridge.env import kernels
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.task import Info, Memory, Task
from nics_drl_bridge.interface import Array, Backend, RobotView
from nics_drl_bridge.kernels import bind


class DirectSteps(NamedTuple):
    """Steps of one robot, bound to arrays that change in place."""

    view: RobotView  # (1, 1) the robot's view
    commands: Array  # (1, 1, C) of the next step
    # writes `commands`; returns False for an action that `Task.drive` must handle
    try_action: Callable[[Any], bool]
    advance: Callable[[Memory], Any]  # moves the robot; the rest as BoundStep


def bind_steps(backend: Backend, task: Task) -> DirectSteps | None:
    """Returns direct steps, or None if backend or task overrides a part of a step."""
    if task.robots > 1 or type(backend) is not SimBackend or not task.binds_all:
        return None
    view = backend.get_live_view()
    if view is None:
        return None
    before = view.pose.copy()
    judge = task.bind(before, view)
    if judge is None:
        return None
    data = backend.simulator.data
    pose = view.pose[0, 0]
    true_pose = data.pose[0, 0]
    collided = data.collided[0]
    commands = np.zeros((1, 1, len(task.robot.command)))
    move = backend.simulator.bind_step(commands)

    def advance(memory: Memory) -> Any:
        before[0, 0] = pose
        move()
        observation, terms, ended, judged = judge(memory)
        info: Info = {}
        for name in task.shown:
            info[name] = memory[name][0, 0].copy()
        info["pose"] = pose.copy()
        info["scan_age_s"] = 0.0
        info["odom_age_s"] = 0.0
        info["stamp_ns"] = backend.now_ns
        info["true_pose"] = true_pose.copy()
        info["true_collision"] = bool(collided)
        return observation, terms, ended, info | judged

    return DirectSteps(view, commands, _bind_actions(task, commands), advance)


def _bind_actions(task: Task, commands: Array) -> Callable[[Any], bool]:
    """Returns `DirectSteps.try_action`."""
    row = np.zeros(commands.shape[2])
    scale = bind(kernels.scale_actions, commands[0], row[None], *task.command_limits)

    def look_up_action(action: Any) -> bool:
        table = task.discrete_commands
        if type(action) not in (int, np.int64) or not 0 <= action < len(table):
            return False
        commands[0, 0] = table[action]
        return True

    def scale_action(action: Any) -> bool:
        if type(action) is not np.ndarray or action.shape != row.shape:
            return False
        if action.dtype.kind != "f":
            return False
        row[:] = action
        return bool(scale())

    for name in ("action_space", "command", "drive"):
        if getattr(type(task), name) is not getattr(Task, name):
            return lambda _: False
    if task.actions == "discrete":
        fits = task.discrete_commands.shape[1:] == row.shape
        return look_up_action if fits else (lambda _: False)
    return (lambda _: False) if task.robot.takes_turn_rate else scale_action
