"""Steps of one robot whose task judges the simulator's own arrays, in less than half the time."""

from collections.abc import Callable
from typing import Any

import numpy as np

from nics_drl_bridge.env import kernels
from nics_drl_bridge.env.sim_backend import SimBackend
from nics_drl_bridge.env.task import BoundStep, Info, Memory, Observation, Task
from nics_drl_bridge.interface import Array, Backend, RobotView
from nics_drl_bridge.kernels import bind


class DirectSteps:
    """Steps of one robot, bound to arrays that change in place.

    Attributes:
        view: what the robot knows, (1, 1).
        commands: (1, 1, C) of the next step.
        take_action: writes `commands`; returns False if an action is for `Task.drive`, or wrong.
    """

    def __init__(
        self,
        backend: SimBackend,
        task: Task,
        view: RobotView,
        before: Array,
        judge: BoundStep,
    ) -> None:
        simulator = backend.simulator
        self.view = view
        self.commands: Array = np.zeros((1, 1, len(task.robot.command)))
        self._task = task
        self._before = before[0, 0]
        self._pose = view.pose[0, 0]
        self._true_pose = simulator.data.pose[0, 0]
        self._collided = simulator.data.collided[0]
        self._steps = simulator.data.steps
        self._period_ns = backend.period_ns
        self._action = np.zeros(len(task.robot.command))
        self._shape = self._action.shape
        self._scale: Callable[[], bool] = bind(
            kernels.scale_actions,
            self.commands[0],
            self._action[None],
            *task.command_limits,
        )
        self.take_action: Callable[[Any], bool] = self._scale_action
        if task.actions == "discrete":
            self.take_action = self._look_up_action
        if not task.commands_plainly:
            self.take_action = lambda _: False
        self._move = simulator.bind_step(self.commands)
        self._judge = judge

    def _look_up_action(self, action: Any) -> bool:
        table = self._task.discrete_commands
        if type(action) not in (int, np.int64) or not 0 <= action < len(table):
            return False
        self.commands[0, 0] = table[action]
        return True

    def _scale_action(self, action: Any) -> bool:
        if type(action) is not np.ndarray or action.shape != self._shape:
            return False
        if action.dtype.kind != "f":
            return False
        self._action[:] = action
        return self._scale()

    def advance(
        self, memory: Memory
    ) -> tuple[Observation, dict[str, float], bool, Info]:
        """Moves the robot; returns observation, reward terms, True at the end, and `info`."""
        self._before[:] = self._pose
        self._move()
        observation, terms, ended, judged = self._judge(memory)
        info: Info = {}
        for name in self._task.shown:
            info[name] = memory[name][0, 0].copy()
        info["pose"] = self._pose.copy()
        info["scan_age_s"] = 0.0
        info["odom_age_s"] = 0.0
        info["stamp_ns"] = self._steps.item() * self._period_ns
        info["true_pose"] = self._true_pose.copy()
        info["true_collision"] = bool(self._collided)
        info |= judged
        return observation, terms, ended, info


def bind_steps(backend: Backend, task: Task) -> DirectSteps | None:
    """Returns direct steps, or None if backend or task moves, measures or judges in its own way."""
    if task.robots > 1 or type(backend) is not SimBackend or not task.binds_all:
        return None
    view = backend.get_live_view()
    if view is None:
        return None
    before = view.pose.copy()
    judge = task.bind(before, view)
    return None if judge is None else DirectSteps(backend, task, view, before, judge)
