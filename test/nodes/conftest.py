import itertools
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from command_line import nics
from domains import claimed_domain

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.generator import SimulatorModel, builtin_model, save_model

LOG_CHARACTERS = 2000
NEEDS_ROS = re.compile(r"^pytestmark = .*mark\.ros", re.MULTILINE)
# Nodes are started with `cmd_vel` as a Twist, whatever the distribution, unless a test asks for
# the other type or for the default: `test_stamped_commands.py` is about these.
LAUNCHED: list[Any] = []
"""The nodes of the running test, and of the others of its module."""


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Without ROS 2, leave out the files whose tests need it."""
    if find_spec("rclpy") is not None or collection_path.suffix != ".py":
        return None
    needs_ros = NEEDS_ROS.search(collection_path.read_text(encoding="utf-8"))
    return True if needs_ros else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    """If a test fails, report what its nodes have logged, too."""
    report = yield
    if report.failed:
        for each in LAUNCHED:
            said = each.log.read_text(encoding="utf-8", errors="replace")[
                -LOG_CHARACTERS:
            ]
            report.sections.append(
                (f"{each.log}, ended with {each._process.poll()}", said)
            )
    return report


# Modules below import rclpy, so the fixtures import them.


@pytest.fixture(scope="session")
def model() -> SimulatorModel:
    """A car, driven once so that everything is compiled."""
    built = builtin_model("ackermann")
    env = BridgeEnv(model=built)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    return built


@pytest.fixture(scope="session")
def model_folder(
    model: SimulatorModel, tmp_path_factory: pytest.TempPathFactory
) -> str:
    folder = tmp_path_factory.mktemp("model") / "ackermann"
    save_model(model, folder)
    return str(folder)


@pytest.fixture(scope="module")
def domains() -> Iterator[ExitStack]:
    """The domains of a module, which stay claimed until its end."""
    with ExitStack() as claimed:
        yield claimed


@pytest.fixture
def domain_id(domains: ExitStack) -> int:
    return domains.enter_context(claimed_domain())


@pytest.fixture(scope="module")
def module_domain_id(domains: ExitStack) -> int:
    return domains.enter_context(claimed_domain())


@pytest.fixture
def make_node(domain_id: int) -> Iterator[Callable[..., Any]]:
    """Makes nodes that do not spin, `make_node("rate:=2.0", words=("-r", "__ns:=/car"))`."""
    from nics_drl_bridge.nodes.listener import open_context
    from nics_drl_bridge.nodes.qos import BridgeNode

    with ExitStack() as made:

        def make(*parameters: str, kind: Any = None, words: Sequence[str] = ()) -> Any:
            given = [word for each in parameters for word in ("-p", each)]
            context = open_context(["node", "--ros-args", *given, *words], domain_id)
            made.callback(context.try_shutdown)
            node = (
                BridgeNode("node", context=context)
                if kind is None
                else kind(context=context)
            )
            made.callback(node.destroy_node)
            return node

        yield make


@pytest.fixture
def direct(
    make_node: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Any]:
    """Makes nodes that do not spin and whose messages are kept, `direct("rate:=2.0", kind=...)`."""
    from nics_drl_bridge.nodes.qos import BridgeNode
    from nics_drl_bridge.nodes.runner import ManagedNode
    from nodes.direct import Direct, Kept

    def keep(node: Any, kind: Any, topic: str, *_: Any, **__: Any) -> Kept:
        return Kept(node, kind, topic)

    monkeypatch.setattr(BridgeNode, "create_publisher", keep)
    monkeypatch.setattr(ManagedNode, "create_lifecycle_publisher", keep)

    def make(*parameters: str, **options: Any) -> Direct:
        node = make_node(*parameters, **options)
        if isinstance(node, ManagedNode):
            node.start()
        return Direct(node)

    return make


@pytest.fixture
def logged() -> list[str]:
    """The lines that nodes log in the thread of the test."""
    from nodes.in_process import LINES

    LINES["MainThread"].clear()
    return LINES["MainThread"]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The time of the nodes that `direct` makes, which stands still by itself."""
    from nics_drl_bridge.nodes import command_gate, record_node, simulator_node
    from nodes.direct import Clock

    clock = Clock()
    clock.now_s = 1000.0
    for module in (command_gate, record_node, simulator_node):
        monkeypatch.setattr(module, "time", clock)
    return clock


def starter(
    kind: Any, model_folder: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., Any]]:
    numbers = itertools.count()
    with ExitStack() as started:

        def start(
            node: str,
            domain_id: int,
            namespace: str = "",
            remap: dict[str, str] | None = None,
            **parameters: Any,
        ) -> Any:
            folder: Path = tmp_path_factory.mktemp(f"{node}_{next(numbers)}")
            own = {"model": model_folder}
            if node == "record_node":
                own = {"robot": "ackermann"}
            parameters = {**own, "enable_stamped_cmd_vel": False} | parameters
            LAUNCHED.append(kind(node, folder, parameters, domain_id, namespace, remap))
            return started.enter_context(LAUNCHED[-1])

        yield start
        LAUNCHED.clear()


@pytest.fixture(scope="module")
def launch(
    domains: ExitStack, model_folder: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., Any]]:
    """Starts nodes in threads, `launch(node, domain_id, **parameters)`, until the module ends."""
    from nodes.in_process import NodeThread

    yield from starter(NodeThread, model_folder, tmp_path_factory)


@pytest.fixture(scope="module")
def launch_process(
    domains: ExitStack, model_folder: str, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., Any]]:
    """The same in processes, for promises of processes."""
    from nics_drl_bridge.nodes.processes import NodeProcess

    yield from starter(NodeProcess, model_folder, tmp_path_factory)


@pytest.fixture(scope="module")
def meet(domains: ExitStack) -> Iterator[Callable[..., Any]]:
    """Makes peers, `meet(domain_id)`; all are closed with the module."""
    from nodes.peer import Peer

    peers = []

    def make(domain_id: int, namespace: str = "") -> Peer:
        peers.append(Peer(domain_id, namespace))
        return peers[-1]

    yield make
    for each in peers:
        each.close()


@pytest.fixture
def restored_signals() -> Iterator[None]:
    """The handlers of signals as they were, after commands that set their own."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    yield
    for number, handler in before.items():
        if handler is not None and signal.getsignal(number) != handler:
            signal.signal(number, handler)


@pytest.fixture
def interrupt(
    domain_id: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    restored_signals: None,
) -> Callable[..., Any]:
    """Runs `nics` in this process until `play()` returns, and then Ctrl-C, in another thread."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))

    def run(play: Callable[[], object], *words: object) -> Any:
        def act() -> None:
            try:
                play()
            finally:
                os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=act)
        thread.start()
        try:
            return nics(*words, cwd=tmp_path)
        finally:
            thread.join()

    return run
