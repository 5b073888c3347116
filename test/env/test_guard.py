"""Whatever leaves a method of an env by an exception leaves a zero command behind."""

from __future__ import annotations

import signal
import threading
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.guard import stop_on_error
from nics_drl_bridge.env.pettingzoo_env import BridgeParallelEnv
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.env.tasks.navigation import Navigation
from nics_drl_bridge.env.tasks.teams import CooperativeReaching
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.interface import RobotView
from nics_drl_bridge.policy.evaluation import drive

MODEL = direct_model()
FIELD = field()
AHEAD = np.array([1.0, 0.5, -0.5], np.float32)
ERRORS = (
    ValueError,
    ConfigError,
    MemoryError,
    RecursionError,
    KeyboardInterrupt,
    SystemExit,
)
OF_TASK = (
    "reset",
    "command",
    "step_into",
    "update",
    "observation",
    "reward",
    "end",
    "info",
)


class Fault:
    """Raises an error at one of the calls that pass through it."""

    def __init__(self, when=-1, error=ValueError):
        self.when = when
        self.error = error
        self.calls = 0
        self.names = set()

    def at(self, name):
        self.names.add(name)
        self.calls += 1
        if self.calls - 1 == self.when:
            raise self.error("thrown")


FAULT = SimpleNamespace(now=Fault())


def throwing(base, whole):
    """A task each of whose methods may raise; `whole` judges a step in one pass."""

    def method(name):
        inner = getattr(Task if name == "step_into" and not whole else base, name)

        def call(self, *arguments):
            FAULT.now.at(name)
            result = inner(self, *arguments)
            FAULT.now.at(f"{name}, done")
            return result

        return call

    return type("Throwing", (base,), {name: method(name) for name in OF_TASK})


class Robot:
    """A backend that is a robot, which drives on as it was told last."""

    def __init__(self, robots=1):
        self.lead = () if robots == 1 else (robots,)
        self.last = np.zeros((*self.lead, 3))
        self.driven = 0
        self.pose = None

    def view(self):
        ranges = np.full((*self.lead, MODEL.lidar.beams), np.inf, np.float32)
        return RobotView(self.pose, self.last.copy(), ranges, 0.0, 0.0, 0.0)

    def reset(self, start):
        FAULT.now.at("backend reset")
        self.pose = start.pose.copy()
        return self.view()

    def step(self, command):
        FAULT.now.at("backend step")
        self.last = np.array(command)
        self.driven += bool(self.last.any())
        FAULT.now.at("backend step, done")
        return self.view(), {}

    def halt(self):
        self.last = np.zeros_like(self.last)

    def facts(self):
        FAULT.now.at("backend facts")
        return {}

    def close(self):
        FAULT.now.at("backend close")
        self.halt()


class RobotWithoutHalt(Robot):
    """It is halted by a step; where that itself fails nobody can help."""

    halt = None

    def step(self, command):
        if np.any(command):
            return super().step(command)
        self.last = np.array(command)
        return self.view(), {}

    def close(self):
        FAULT.now.at("backend close")
        self.last = np.zeros_like(self.last)


class Picture:
    def draw(self, *_):
        FAULT.now.at("picture draw")

    def close(self):
        FAULT.now.at("picture close")


def single(robot, whole, mode):
    return BridgeEnv(robot, MODEL, FIELD, throwing(Navigation, whole), render_mode=mode)


def team(robot, whole, mode):
    task = throwing(CooperativeReaching, whole)
    options = {"robots": 2}
    return BridgeEnv(robot, MODEL, FIELD, task, options, render_mode=mode)


def parallel(robot, whole, mode):
    task = throwing(CooperativeReaching, whole)
    options = {"robots": 2}
    agents = BridgeParallelEnv(MODEL, FIELD, task, options, render_mode=mode)
    agents.env._backend = robot
    return agents


ENVS = {"single": (single, 1), "team": (team, 2), "parallel": (parallel, 2)}


def action_of(env, value):
    if isinstance(env, BridgeParallelEnv):
        return dict.fromkeys(env.agents, value)
    return np.tile(value, env.robots) if isinstance(value, np.ndarray) else value


BAD_ACTIONS = (
    AHEAD * np.nan,
    AHEAD * np.inf,
    AHEAD[:2],
    None,
    "ahead",
    object(),
    3,
    [[AHEAD]],
)
CALLS = st.one_of(
    st.just(("step", (AHEAD,), {})),
    st.sampled_from(BAD_ACTIONS).map(lambda value: ("step", (value,), {})),
    st.just(("render", (), {})),
    st.just(("reset", (), {"seed": 3})),
    st.sampled_from([-1, 2**63, 2**70, 10**6000, 1.5, "x", np.int64(3), (1,)]).map(
        lambda seed: ("reset", (), {"seed": seed})
    ),
    st.sampled_from(
        [
            {"strat": 0},
            {"start": (1.0,)},
            {"start": "there"},
            {"goal": np.nan},
            [1],
            "start",
            7,
        ]
    ).map(lambda options: ("reset", (), {"options": options})),
    st.sampled_from(["step", "advance"]).map(lambda name: (name, (), {})),
    st.just(("reset", (), {"unknown": 1})),
    st.just(("render", (1, 2), {})),
    st.just(("close", (), {})),
)
STEPS = [("step", (AHEAD,), {})] * 3
PLANS = st.one_of(st.lists(CALLS, max_size=8), st.just([*STEPS, ("render", (), {})]))
WHENS = st.one_of(st.integers(0, 12), st.integers(0, 80))


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(sorted(ENVS)),
    st.sampled_from([Robot, RobotWithoutHalt]),
    st.booleans(),
    st.sampled_from(["rgb_array", "human"]),
    WHENS,
    st.sampled_from(ERRORS),
    PLANS,
)
def test_the_last_word_to_a_robot_is_zero_whatever_is_thrown_from_wherever(
    kind, make_robot, whole, mode, when, error, plan
):
    make, robots = ENVS[kind]
    robot = make_robot(robots)
    if kind == "parallel":
        robot.halt = Robot.halt.__get__(robot)
    FAULT.now = Fault()
    env = make(robot, whole, mode)
    of_agents = env.env if kind == "parallel" else env
    of_agents._picture = Picture()
    FAULT.now = Fault(when, error)
    for name, arguments, named in [("reset", (), {"seed": 0}), *STEPS[:1], *plan]:
        if name == "step" and arguments:
            arguments = (action_of(env, *arguments),)
        try:
            getattr(env if hasattr(env, name) else of_agents, name)(*arguments, **named)
        except BaseException:  # noqa: BLE001
            assert not robot.last.any()
            refused = (
                gymnasium.error.ResetNeeded,
                gymnasium.error.ClosedEnvironmentError,
            )
            with pytest.raises(refused):
                of_agents.step(np.tile(AHEAD, robots))
            assert not robot.last.any()
        of_agents._picture = Picture()
    FAULT.now = Fault()
    if of_agents._closed:
        assert not robot.last.any()
        return
    env.reset(seed=0)
    before = robot.driven
    env.step(action_of(env, AHEAD))
    assert robot.driven > before


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 30),
    st.sampled_from(ERRORS),
    st.sampled_from([Robot, RobotWithoutHalt]),
)
def test_a_policy_or_callback_that_raises_amid_an_episode_stops_the_robot(
    when, error, make_robot
):
    robot = make_robot()
    FAULT.now = Fault()
    env = gymnasium.wrappers.TimeLimit(single(robot, True, None), 20)
    env.reset(seed=0)  # once rehearses a step, in which a ConfigError says nothing

    def act(_):
        FAULT.now.at("policy")
        return AHEAD

    FAULT.now = Fault(when, error)
    with pytest.raises(error):  # noqa: PT012
        for seed in range(20):
            begin = partial(FAULT.now.at, "on_start")
            drive(env, SimpleNamespace(act=act), seed, None, begin)
    assert not robot.last.any()


def test_a_backend_that_was_told_nothing_is_not_stepped_to_halt_it():
    """It may never have been reset, and would say something else than what is wrong."""
    env = BridgeEnv(RobotWithoutHalt(), MODEL, FIELD)
    FAULT.now = Fault()
    with pytest.raises(ConfigError, match="seed -1"):
        env.reset(seed=-1)


def test_everything_that_an_env_calls_was_thrown_from():
    """The property above would be empty where nothing passes through the fault."""
    FAULT.now, names = Fault(), set()
    for whole in (True, False):
        env = single(Robot(), whole, "human")  # the page alone is closed
        env._picture = Picture()
        env.reset(seed=0)
        env.step(AHEAD)
        env.render()
        env.close()
        names |= FAULT.now.names
    backend = {
        "backend reset",
        "backend step",
        "backend close",
        "picture draw",
        "picture close",
    }
    assert names >= backend | set(OF_TASK)


def test_a_picture_that_cant_be_closed_keeps_no_backend_open():
    FAULT.now = Fault()
    env = single(Robot(), True, "human")
    env._picture = Picture()
    env.reset(seed=0)
    env.step(AHEAD)
    FAULT.now = Fault(1)
    with pytest.raises(ValueError, match="thrown"):
        env.close()
    assert FAULT.now.names == {"backend close", "picture close"}
    assert not env._backend.last.any()
    env.close()  # twice does no harm


class Stubborn:
    """Told to stop, it is asked for a moment whether Ctrl-C comes through."""

    def __init__(self, press):
        self.press = press
        self.halted = 0

    def halt(self):
        self.press()
        self.halted += 1

    @stop_on_error
    def step(self):
        raise ValueError("the first")


def test_ctrl_c_does_not_cut_short_what_stops_the_robot_and_is_answered_afterwards():
    robot = Stubborn(lambda: signal.raise_signal(signal.SIGINT))
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught:
        robot.step()
    assert isinstance(caught.value.__context__, ValueError)
    assert robot.halted == 1
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_in_a_thread_stops_the_robot_too():
    robot = Stubborn(lambda: None)
    caught = []

    def run():
        try:
            robot.step()
        except ValueError as error:
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert (robot.halted, len(caught)) == (1, 1)


def test_an_error_while_stopping_tells_of_both():
    def fails():
        raise ConnectionError("no robot")

    with pytest.raises(ConnectionError, match="no robot") as caught:
        Stubborn(fails).step()
    assert str(caught.value.__context__) == "the first"
