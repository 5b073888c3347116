"""An executor whose wait set stands, instead of being made anew for each message."""

from __future__ import annotations

import contextlib
import inspect
import itertools
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any

from rclpy.context import Context
from rclpy.executors import (
    ExternalShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities

from nics_drl_bridge.interface import NS_PER_S

PARTS_MISSING = (AttributeError, TypeError)
"""What Python raises where rclpy is another one than is known here."""
Received = tuple[Callable[..., Any], tuple[Any, ...]]
"""A callback and its arguments."""
HANDED_OVER = object()
"""What a callback returns that has woken another thread of this process. The executor then rests,
for less than an exchange of messages takes, rather than be in that thread's way."""
REST_S = 1e-4
MOST_AT_ONCE = 32
"""A timer without a period is always ready, and who spins wants to look after other things too."""


class StandingExecutor(SingleThreadedExecutor):
    """Waits for all ends of its nodes; calls back subscriptions itself and leaves the rest.

    rclpy's executors gather the ends of all nodes, open their handles and make a new wait set
    each time they wait, and they wait three times for one message, woken by their own guard
    condition. Here that is done when an end comes or goes. Whatever is no subscription and no timer
    (services, clients, events, tasks) is left to rclpy's own executor.

    Callbacks of subscriptions are plain functions of the message, or of it and what is known about
    it; those of timers are plain functions of nothing, others are left to rclpy, too. They are
    called in the thread that spins, one after the other. See `HANDED_OVER` for what those of
    subscriptions may return.

    That needs parts of rclpy that no interface promises. With an rclpy that lacks one of them it
    says so once in the log, and is rclpy's own executor from then on.

    Args:
        context: of the nodes.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context=context)
        self._ends: _Ends | None = None
        self._changed, self.stands = True, True

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Waits for something and handles it; see rclpy.

        Raises:
            ExternalShutdownException: the context is shut down.
        """
        received: list[Received] = []
        if self.stands:
            try:
                received = self._wait(timeout_sec)
            except PARTS_MISSING as error:
                self._fall_back(error)
        if not self.stands:
            super().spin_once(timeout_sec)
            return
        # Before anything else is looked at: somebody may wait for the answer to a message.
        _call(received)
        due, others = self._others_ready()
        if received:
            _call(self._come_since())
        for timer in due:
            self._tick(timer)
        if others:
            self._handle_others()

    def _wait(self, timeout_sec: float | None) -> list[Received]:
        """Waits; what subscriptions received."""
        try:
            ends = self._gathered()
            ends.wait(-1 if timeout_sec is None else int(timeout_sec * NS_PER_S))
        except RuntimeError:  # of the library, whose context another thread may have shut down
            if self.context.ok():
                raise
        if not self.context.ok():
            raise ExternalShutdownException
        return ends.taken()

    def _come_since(self) -> list[Received]:
        """What has come while callbacks ran; to take it costs less than to wait for it."""
        return [] if self._ends is None or not self.context.ok() else self._ends.come()

    def _others_ready(self) -> tuple[list[Any], bool]:
        """Timers that are due, and whether anything else but subscriptions was ready."""
        if self._ends is None or not self.context.ok():  # a callback may have shut all down
            return [], False
        try:
            due = self._ends.due()
            woken, others = self._ends.others_ready(self._guard)
            self._changed |= woken or others  # whoever adds an end to a node wakes the executor
            # So does rclpy itself, after each callback; then there is nothing to handle.
            return due, others or (woken and bool(self._tasks))
        except PARTS_MISSING as error:
            self._fall_back(error)
            return [], False

    def _tick(self, timer: Any) -> None:
        """Calls a timer back, unless a callback before it has ended all, or that timer."""
        if not self.context.ok() or not any(timer in node.timers for node in self.get_nodes()):
            return
        try:
            if not timer.handle.is_timer_ready():
                return
            timer.handle.call_timer()  # it is due again after another period
        except PARTS_MISSING as error:
            self._fall_back(error)
            return
        timer.callback()

    def _fall_back(self, error: Exception) -> None:
        """Goes on as rclpy's own executor."""
        self.stands = False
        self._release()
        get_logger("executor").warning(f"this rclpy needs its own, slower executor ({error})")

    def _handle_others(self) -> None:
        """Lets rclpy handle all that is ready now."""
        with contextlib.suppress(TimeoutException):
            for _ in range(MOST_AT_ONCE):
                if not self.context.ok():  # a callback may have ended it
                    raise ExternalShutdownException
                task, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
                task()
                task.result()  # raises what the callback did

    def _gathered(self) -> _Ends:
        """The ends that there are, in a new wait set if they are others than before."""
        if self._ends is None or self._changed:
            self._changed = False
            nodes = self.get_nodes()
            if self._ends is None or self._ends.all != _all_ends(nodes):
                self._release()
                guards = [guard for guard in (self._guard, self._sigint_gc) if guard]
                self._ends = _Ends(nodes, guards, self.context)
        return self._ends

    def _release(self) -> None:
        if self._ends is not None:
            self._ends.close()
            self._ends = None

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Lets go of all ends; see rclpy."""
        self._release()
        return bool(super().shutdown(timeout_sec))


class _Ends:
    """The ends of nodes, their handles held open, and a wait set with room for all of them."""

    def __init__(self, nodes: Sequence[Node], guards: Sequence[Any], context: Context) -> None:
        self.all = _all_ends(nodes)
        subscriptions, others, timers, clients, services, self._waitables = self.all
        self._subscriptions = [(one, _arguments(one.callback)) for one in subscriptions]
        self._timers = [(i, one) for i, one in enumerate(timers) if _plain(one.callback)]
        self._own = {one.handle.pointer for _, one in self._timers}
        kinds = subscriptions, (*guards, *others), timers, clients, services
        self._open = ExitStack()
        for held in (*(end.handle for end in itertools.chain(*kinds)), *self._waitables):
            self._open.enter_context(held)
        self._open.enter_context(context.handle)
        room = NumberOfEntities(*(len(ends) for ends in kinds))
        for waitable in self._waitables:
            room += waitable.get_num_entities()
        self._wait_set = rclpy_implementation.WaitSet(
            room.num_subscriptions, room.num_guard_conditions, room.num_timers,
            room.num_clients, room.num_services, room.num_events, context.handle,
        )  # fmt: skip
        add: Any = self._wait_set
        adders = (
            add.add_subscription, add.add_guard_condition, add.add_timer, add.add_client,
            add.add_service,
        )  # fmt: skip
        self._adding = [
            (adder, end.handle) for adder, ends in zip(adders, kinds, strict=True) for end in ends
        ]

    def wait(self, timeout_ns: int) -> None:
        """Waits until something is ready; for ever if the timeout is negative."""
        self._wait_set.clear_entities()  # each wait forgets those that were not ready
        for add, handle in self._adding:
            add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._wait_set.wait(timeout_ns)

    def taken(self) -> list[Received]:
        """What the subscriptions received that waiting found ready."""
        is_ready = self._wait_set.is_ready
        found = enumerate(self._subscriptions)
        return _take(entry for i, entry in found if is_ready("subscription", i))

    def come(self) -> list[Received]:
        """What any subscription has received by now."""
        return _take(self._subscriptions)

    def due(self) -> list[Any]:
        """The timers with plain callbacks that waiting found ready."""
        is_ready = self._wait_set.is_ready
        return [timer for i, timer in self._timers if is_ready("timer", i)]

    def others_ready(self, own: Any) -> tuple[bool, bool]:
        """Whether the executor's own guard condition is ready, and what is left to rclpy."""
        ready = self._wait_set.get_ready_entities
        triggered = list(ready("guard_condition"))
        for guard in self.all[1]:
            if guard.handle.pointer in triggered:
                guard._executor_triggered = True  # waiting has reset it; rclpy sets it anew
        woken = own is not None and own.handle.pointer in triggered
        if woken:
            triggered.remove(own.handle.pointer)
        others = bool(triggered or ready("client") or ready("service"))
        others = others or any(timer not in self._own for timer in ready("timer"))
        return woken, others or any(
            waitable.is_ready(self._wait_set) for waitable in self._waitables
        )

    def close(self) -> None:
        """Lets go of the handles."""
        self._open.close()


def _take(subscriptions: Iterable[tuple[Any, int]]) -> list[Received]:
    """One message of each subscription that has one, for its callback of so many arguments."""
    received = []
    for subscription, arguments in subscriptions:
        taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is not None:
            received.append((subscription.callback, taken[:arguments]))
    return received


def _call(received: Iterable[Received]) -> None:
    """Calls back, and rests if another thread now goes on."""
    handed_over = False
    for callback, arguments in received:
        handed_over |= callback(*arguments) is HANDED_OVER
    if handed_over:
        time.sleep(REST_S)


def _arguments(callback: Callable[..., Any]) -> int:
    """How many a subscription's callback takes: the message, or with it what is known about it."""
    try:
        inspect.signature(callback).bind(None)
    except TypeError:
        return 2
    return 1


def _plain(callback: Callable[..., Any] | None) -> bool:
    """Whether a timer's callback is a function of nothing that does not have to be awaited."""
    try:
        inspect.signature(callback).bind()  # type: ignore[arg-type]
    except TypeError:
        return False
    return not inspect.iscoroutinefunction(callback)


def _all_ends(nodes: Sequence[Node]) -> tuple[tuple[Any, ...], ...]:
    """Subscriptions, guard conditions, timers, clients, services and waitables of nodes."""
    kinds = ("subscriptions", "guards", "timers", "clients", "services", "waitables")
    return tuple(tuple(end for node in nodes for end in getattr(node, kind)) for kind in kinds)
