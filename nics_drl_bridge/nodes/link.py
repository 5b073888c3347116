"""Link to a robot: the rclpy entities of this process, which never leave the robot moving.

In lock-step the caller's thread runs the callbacks while it waits. In real time a thread of the
link does so from `begin` on, because topics and the command's timeout go on between two steps.
"""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import Twist, TwistStamped
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from nics_drl_bridge.config import parse_namespace
from nics_drl_bridge.env.guard import delay_interrupts
from nics_drl_bridge.errors import BackendError, ModelError
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.interface import S_PER_NS, Start
from nics_drl_bridge.middleware.measurement import CMD_VEL
from nics_drl_bridge.nodes import qos, wire
from nics_drl_bridge.nodes.command_types import expect_stamped
from nics_drl_bridge.nodes.listener import POLL_S, SpunNode, ask, spin
from nics_drl_bridge.nodes.own_process import ENDING
from nics_drl_bridge.nodes.parameters import is_stamped_default
from nics_drl_bridge.nodes.runner import call_periodically, publish_last
from nics_drl_bridge.nodes.wire import write_stamped_twist, write_twist
from nics_drl_bridge.sim.randomisation import Randomisation
from nics_drl_bridge.sim.world_set import AnyWorld

LOOK_S = 0.05  # between two looks at a command's timeout [s]
NO_RANDOMISATION = "none"
# key of the stamp of an episode's first data in a simulator's diagnostics
EPISODE_NS = "episode began [ns]"
# a request that may be sent again counts as lost if unanswered for this long [s]
LOST_S = 1.0


class Link(SpunNode):
    """A node in its own context; its end or silence leaves a zero command behind."""

    def __init__(
        self,
        namespace: str = "",
        domain_id: int | None = None,
        command_topic: str = CMD_VEL,
        stamped: bool | None = None,
        parameters: Mapping[str, Any] | None = None,
        command_timeout_s: float = math.inf,
        patience_s: float = 0.0,
    ) -> None:
        if threading.current_thread() is threading.main_thread():
            # Signals end Python like an exception, unless the program handles them itself.
            for number in ENDING:
                if signal.getsignal(number) is signal.SIG_DFL:
                    signal.signal(number, lambda number, _: sys.exit(128 + number))
        overrides = [
            Parameter(name, value=value) for name, value in (parameters or {}).items()
        ]
        super().__init__(
            "bridge_env",
            domain_id,
            parse_namespace(namespace),
            qos.BridgeNode,
            parameter_overrides=overrides,
        )
        self._began_s = time.monotonic()
        self._undo = contextlib.ExitStack()
        self._undo.callback(self._context.try_shutdown)
        self._undo.callback(self.node.destroy_node)
        self._undo.callback(self._executor.shutdown, timeout_sec=1.0)
        # Also applies if the link never begins or its owner fails to construct.
        self._closing = weakref.finalize(self, _shut_down, self._undo)
        try:
            if stamped is None:
                stamped = self.expects_stamped(command_topic, patience_s)
            # frame of the robot, in which commands are given; unknown until it is set
            self.frame = ""
            self.stamped = stamped
            self._kind: Any = TwistStamped if stamped else Twist
            self.commands = self.node.create_publisher(
                self._kind, command_topic, qos.COMMAND
            )
            self._topic = self.commands.topic_name
            self._timeout = CommandTimeout(
                self._context, self.commands, self._kind, command_timeout_s
            )
        except BaseException:
            self.close()
            raise

    def spin(self, timeout_s: float = POLL_S) -> None:
        """Wait for a moment for a callback, and run it; only without the link's own thread.

        Ctrl-C waits for its end, or it could leave the executor amid its bookkeeping, after which
        no callback would ever run again.
        """
        try:
            with delay_interrupts():
                super().spin(timeout_s)
        except ExternalShutdownException:
            self.check_open()

    def expects_stamped(self, topic: str, patience_s: float) -> bool:
        """Wait for a subscriber of commands; True if it expects stamped ones, or by default."""
        name = self.node.resolve_topic_name(topic)
        self.until(lambda: self.node.count_subscribers(name) > 0, patience_s)
        heard = expect_stamped(self.node, topic)
        return is_stamped_default() if heard is None else heard

    def begin(self) -> None:
        """Let a thread run the callbacks; call it once all subscriptions exist."""
        call_periodically(self.node, LOOK_S, self._timeout.look)
        self._thread = threading.Thread(
            target=_spin,
            args=(self.node, self._timeout),
            daemon=True,
            name="dds_backend",
        )
        # Otherwise Python may exit while the thread is inside the middleware's library.
        self._undo.callback(_join, self._thread)
        self._undo.callback(self._context.try_shutdown)
        self._thread.start()

    def send(self, twist: NDArray[np.float64], stamp_ns: int = 0) -> None:
        """Publish linear.x, linear.y, angular.z (3,); for NaN or inf, a zero and BackendError."""
        if not all(map(math.isfinite, twist)):
            self.halt()
            raise BackendError(
                f"command {twist} for {self._topic}: must be finite, a zero was sent instead; "
                "look at what the task's `command` returns."
            )
        self._timeout.begin(moving=True)
        if self._kind is Twist:
            self.commands.publish(write_twist(twist))
        else:
            self.commands.publish(write_stamped_twist(twist, stamp_ns, self.frame))

    def halt(self) -> None:
        """Publish a zero command."""
        if self._context.ok():
            self._timeout.begin(moving=False)
            self.commands.publish(self._kind())

    def check_open(self) -> None:
        """Raise BackendError if the link is closed."""
        if not self._closing.alive or not self._context.ok():
            raise BackendError("this backend is closed; make another one.")

    def call(
        self,
        client: Any,
        request: Any,
        timeout_s: float,
        retry_period_s: float = math.inf,
    ) -> Any:
        """Call a service, and again at a period; return the first answer. Raises BackendError."""
        answer = ask(client, request, timeout_s, self.until, retry_period_s)
        if answer is None:
            raise BackendError(
                f"service {client.srv_name}: no answer within {timeout_s:g} s; look at the "
                "simulator's log."
            )
        return answer

    def has_rivals(self) -> bool:
        """True if another node publishes commands too."""
        with self.node.handle:  # rclpy's own count checks the name each time
            return bool(self.node.handle.get_count_publishers(self._topic) > 1)

    def check_alone(self) -> None:
        """Raise BackendError with the names of any other publishers of commands."""
        if not self.has_rivals():
            return
        topic = self._topic
        ends = self.node.get_publishers_info_by_topic(topic)
        names = sorted(qos.list_owners(ends))
        with contextlib.suppress(ValueError):
            names.remove(self.node.get_fully_qualified_name())
        raise BackendError(
            f"{', '.join(names) or 'another node'} publishes {topic} too; stop it."
        )

    def wait_for_peers(
        self,
        topics: Sequence[str],
        clients: Sequence[Any],
        patience_s: float,
        advice: str,
    ) -> None:
        """Wait until all peers are matched. Raises BackendError naming what is missing."""
        node = self.node
        needed = dict[str, Callable[[], Any]]()
        needed[f"subscriber of {self._topic}"] = self.commands.get_subscription_count
        for name in map(node.resolve_topic_name, topics):
            needed[f"publisher of {name}"] = partial(node.count_publishers, name)
        for client in clients:
            service = node.resolve_service_name(client.srv_name)
            needed[f"service {service}"] = client.service_is_ready
        deadline = self._began_s + patience_s
        left_s = deadline - time.monotonic()
        if not self.until(lambda: all(there() for there in needed.values()), left_s):
            missing = ", no ".join(
                name for name, there in needed.items() if not there()
            )
            raise BackendError(
                f"after {patience_s:g} s there is still no {missing}; {advice}"
            )
        # A publisher that was killed stays in the graph for a while.
        left_s = deadline - time.monotonic()
        self.until(lambda: not self.has_rivals(), left_s)
        self.check_alone()
        self._undo.callback(self._timeout.end)  # before that, nothing was commanded
        gc.collect()  # now, because later it may take 0.1 s while the robot moves

    def close(self) -> None:
        """Publish a zero command and end the node."""
        self._closing()


def _spin(node: Node, timeout: CommandTimeout) -> None:
    try:
        spin(node, threading.Event())
    finally:  # after an error too, since nothing would notice old data
        timeout.end()
        node.context.try_shutdown()


def _shut_down(undo: contextlib.ExitStack) -> None:
    with delay_interrupts():
        undo.close()


def _join(thread: threading.Thread) -> None:
    # Garbage collection may run this in any thread, including the link's own.
    if thread.is_alive() and thread is not threading.current_thread():
        thread.join(timeout=2.0)


class CommandTimeout:
    """Ends a command if its sender, which may have failed or hang, is silent beyond a limit [s]."""

    # It keeps no reference to the link, so that the link can be garbage-collected.
    def __init__(
        self, context: Context, publisher: Publisher, kind: Any, limit_s: float
    ) -> None:
        self._context = context
        self._publisher = publisher
        self._kind = kind
        self._limit_s = limit_s
        self._due_s = self._answered_s = math.inf

    def begin(self, moving: bool) -> None:
        """Restart the timeout; call it before a command is published, zero or not."""
        self._due_s = time.monotonic() + self._limit_s if moving else math.inf

    def look(self) -> None:
        """Publish one zero when the time is over; called often, in another thread."""
        due_s = self._due_s
        if due_s != self._answered_s and time.monotonic() >= due_s:
            self._answered_s = due_s
            self._publisher.publish(self._kind())

    def end(self) -> None:
        """Publish the last zero and wait for its delivery, unless the context has ended."""
        if self._context.ok():
            publish_last(self._publisher, self._kind())


def get_fingerprints(
    model: SimulatorModel, world: AnyWorld, randomisation: Randomisation | None
) -> dict[str, str]:
    """Return the fingerprints of what a simulator simulates; randomisation may be `none`."""
    drawn = NO_RANDOMISATION if randomisation is None else randomisation.fingerprint
    return {
        "model": model.fingerprint,
        "world": world.fingerprint,
        "randomisation": drawn,
    }


class EpisodeServices:
    """The services of a simulator node for beginning an episode of a model in a world."""

    def __init__(
        self,
        link: Link,
        simulator: str,
        model: SimulatorModel,
        world: AnyWorld,
        randomisation: Randomisation | None = None,
    ) -> None:
        self._link = link
        self._identity = get_fingerprints(model, world, randomisation)
        client = link.node.create_client
        setting = f"{simulator}/set_parameters_atomically"
        self._parameters = client(SetParametersAtomically, setting)
        self._reset = client(Trigger, f"{simulator}/reset")
        self._repeat = client(Trigger, f"{simulator}/repeat")
        self._test = client(SelfTest, f"{simulator}/self_test")
        self._repeating: Any = None
        self._asked_s = 0.0
        self.clients = [self._reset, self._parameters, self._test]

    @property
    def there(self) -> bool:
        """True if a simulator offers the services."""
        return all(client.service_is_ready() for client in self.clients)

    def repeat(self) -> None:
        """Request the present data again, without waiting, unless such a request is pending."""
        now = time.monotonic()
        asked = self._repeating
        if asked is not None and not asked.done():
            if now - self._asked_s < LOST_S:
                return
            self._repeat.remove_pending_request(asked)
        if self._repeat.service_is_ready():
            self._repeating = self._repeat.call_async(Trigger.Request())
            self._asked_s = now

    def begin(self, start: Start, timeout_s: float) -> int:
        """Begin an episode; return the stamp of its first data [ns]. Raises BridgeError."""
        chosen = {
            "episode_seed": int(start.seed),
            "episode_start": start.pose.ravel().tolist(),
        }
        settings = [
            Parameter(name, value=value).to_parameter_msg()
            for name, value in chosen.items()
        ]
        request = SetParametersAtomically.Request(parameters=settings)
        # The middleware drops answers to clients that the simulator has not discovered yet, and a
        # second reset would begin another episode. A simulator that answers the client that was
        # made last knows the others, too.
        facts = self._read_facts(timeout_s)
        for key, mine in self._identity.items():
            if facts.get(key) != mine:
                raise ModelError(
                    f"the simulator runs the {key} {facts.get(key)!r}, this env {mine!r}; "
                    f"start both with the same {key}."
                )
        result = self._link.call(self._parameters, request, timeout_s).result
        if not result.successful:
            raise BackendError(f"the simulator refused the episode: {result.reason}")
        response = self._link.call(self._reset, Trigger.Request(), timeout_s)
        if not response.success:
            raise BackendError(f"the simulator could not reset: {response.message}")
        return int(self._read_facts(timeout_s)[EPISODE_NS])

    def _read_facts(self, timeout_s: float) -> dict[str, str]:
        """Return what the simulator tells about itself; asking again does no harm."""
        tested = self._link.call(self._test, SelfTest.Request(), timeout_s, LOST_S)
        return {pair.key: pair.value for pair in tested.status[0].values}


T = TypeVar("T")


class Message(NamedTuple):
    """A serialised message; the defaults stand for a topic without any."""

    stamp_ns: int = -1
    arrival_ns: int = 0  # on the monotonic clock
    content: bytes = b""

    @property
    def age_s(self) -> float:
        """Time since its arrival [s]; inf if there is none."""
        if not self.content:
            return math.inf
        return (time.monotonic_ns() - self.arrival_ns) * S_PER_NS


class Inbox:
    """The newest message of each topic."""

    def __init__(self, topics: tuple[str, ...]) -> None:
        self.messages = dict.fromkeys(topics, Message())

    def put(self, topic: str, content: bytes) -> None:
        """Store a message. Raises BackendError if it is damaged."""
        stamp_ns = read_message(topic, wire.read_stamp, content)
        self.messages[topic] = Message(stamp_ns, time.monotonic_ns(), content)

    def has(self, topic: str, stamp_ns: int) -> bool:
        """True if the message of a stamp is there."""
        return self.messages[topic].stamp_ns >= stamp_ns


def read_message(topic: str, read: Callable[[bytes], T], content: bytes) -> T:
    """Deserialise a message by `read`. Raises BackendError if it is damaged."""
    try:
        return read(content)
    except wire.UNREADABLE as error:
        raise BackendError(
            f"topic {topic!r}: a message can't be read ({error}); check its publisher."
        ) from None
