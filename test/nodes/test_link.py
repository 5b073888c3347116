"""A link leaves nothing open and no robot moving, whatever ends it."""

import math
import os
import signal
import threading
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import Twist

from nics_drl_bridge.errors import BackendError, ConfigError
from nics_drl_bridge.nodes import backends, link, listener, qos
from nics_drl_bridge.nodes.backends import DdsBackend, FleetBackend
from nics_drl_bridge.nodes.link import Link
from nics_drl_bridge.nodes.realtime_backend import RealtimeBackend
from nics_drl_bridge.sim.world import load_world

pytestmark = pytest.mark.ros
OPEN = listener.open_context
AHEAD = np.array([0.5, 0.0, 0.0])


@pytest.fixture
def opened(monkeypatch):
    """The contexts and nodes that links have opened."""
    contexts = []
    nodes = []

    def open_context(*options):
        contexts.append(OPEN(*options))
        return contexts[-1]

    class Node(link.qos.BridgeNode):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            nodes.append(self)

    monkeypatch.setattr(listener, "open_context", open_context)
    monkeypatch.setattr(link.qos, "BridgeNode", Node)
    return contexts, nodes


def fail(*_, **__):
    raise KeyboardInterrupt


def make(kind, model, **options):
    options = {"timeout_s": 0.2} | options
    return kind(model, load_world("empty"), **options)


def make_fleet(model, world, **options):
    return FleetBackend(model, world, ["a", "b"], **options)


CASES = {
    "publisher": (lambda _, **o: Link(**o), (link, "CommandTimeout")),
    "listeners": (lambda _, **o: Link(**o), (Link, "expects_stamped")),
    "services": (partial(make, DdsBackend), (backends, "EpisodeServices")),
    "services of a fleet": (partial(make, make_fleet), (backends, "EpisodeServices")),
    "no simulator": (partial(make, DdsBackend), BackendError),
    "option": (partial(make, RealtimeBackend, pose_type="Pose"), ConfigError),
    "closed": (lambda _, **o: Link(**o).close(), None),
}


@pytest.mark.parametrize("case", CASES)
def test_a_constructor_that_fails_leaves_nothing_open(
    opened, monkeypatch, domain_id, model, case
):
    construct, failure = CASES[case]
    if isinstance(failure, tuple):
        monkeypatch.setattr(*failure, fail)
        failure = KeyboardInterrupt
    if failure is None:
        construct(model, domain_id=domain_id)
    else:
        with pytest.raises(failure):
            construct(model, domain_id=domain_id)
    contexts, nodes = opened
    assert contexts, "nothing was opened"
    assert not any(context.ok() for context in contexts)
    for node in nodes:
        with pytest.raises(Exception, match="destruction was requested"), node.handle:
            pass


def test_ctrl_c_at_any_moment_leaves_the_callbacks_running(domain_id):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    robot = Link(domain_id=domain_id)
    calls = []
    try:
        robot.node.create_timer(0.001, lambda: calls.append(1))
        for delay_s in np.linspace(0.001, 0.03, 40):
            interrupt = partial(os.kill, os.getpid(), signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - it may come at once
                threading.Timer(delay_s, interrupt).start()
                robot.until(lambda: False, 30.0)
        count = len(calls)
        assert robot.until(lambda: len(calls) > count + 10, 30.0)
    finally:
        robot.close()
        signal.signal(signal.SIGINT, before)


def test_a_command_that_is_not_finite_is_never_published_but_a_zero(domain_id):
    robot = Link(domain_id=domain_id, stamped=False)
    sent = []
    robot.commands = SimpleNamespace(publish=sent.append)
    with pytest.raises(BackendError, match="a zero was sent instead"):
        robot.send(np.array([0.5, 0.0, np.nan]))
    assert sent == [Twist()]
    robot.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_would_end_the_program_is_an_exception(number, domain_id):
    """So all that a program leaves by `finally` is left, and a zero command is the last."""
    before = signal.signal(number, signal.SIG_DFL)
    try:
        opened = Link(domain_id=domain_id)
        with pytest.raises(SystemExit) as caught:
            signal.raise_signal(number)
        opened.close()
    finally:
        signal.signal(number, before)
    assert caught.value.code == 128 + number


@pytest.fixture
def drive(meet, domain_id):
    """Make a robot drive that a listener has found, `drive(timeout_s)`."""
    peer = meet(domain_id)
    heard = peer.listen(Twist, "cmd_vel", qos.EVERY_COMMAND)
    made = []

    def start(timeout_s=math.inf):
        robot = Link(domain_id=domain_id, stamped=False, command_timeout_s=timeout_s)
        made.append(robot)
        peer.until(lambda: robot.send(AHEAD) or heard, "a command")
        return robot, peer, heard

    yield start
    for robot in made:
        robot.close()


def test_a_command_that_no_other_one_follows_is_followed_by_a_zero(drive):
    """Its sender may have died of an error that the env never saw."""
    robot, peer, heard = drive(timeout_s=0.3)
    robot.begin()
    for _ in range(2):
        peer.until(lambda: robot.send(AHEAD) or heard[-1] != Twist(), "it drives")
        peer.until(lambda: heard[-1] == Twist(), "a zero command")


def test_the_death_of_the_thread_that_listens_leaves_a_zero_behind(drive, monkeypatch):
    def die(*_, **__):
        raise MemoryError("in the executor")

    robot, peer, heard = drive()
    monkeypatch.setattr(threading, "excepthook", lambda *_: None)
    monkeypatch.setattr(listener.SingleThreadedExecutor, "spin_once", die)
    robot.begin()
    robot._thread.join()
    monkeypatch.undo()
    peer.until(lambda: heard[-1] == Twist(), "a zero command")
    with pytest.raises(BackendError, match="closed"):
        robot.check_open()
