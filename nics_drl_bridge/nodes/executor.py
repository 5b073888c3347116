"""An executor that keeps its wait set: 1.5 times as many lock-step steps per second as rclpy's."""

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

InvalidHandle = rclpy_implementation.InvalidHandle
# raised if this version of rclpy has other internals
PARTS_MISSING = (AttributeError, TypeError)
Received = tuple[Callable[..., Any], tuple[Any, ...]]  # a callback and its arguments
HANDED_OVER = object()
"""Returned by a callback that has woken another thread of this process. The executor then rests, to
leave the processor to that thread."""
REST = 0.4  # length of a rest, as a fraction of the time since the last one
LONGEST_REST_S = 1e-3
# A timer without a period is always ready, but the thread has other work too.
MOST_AT_ONCE = 32


class StandingExecutor(SingleThreadedExecutor):
    """Handles frequent events itself; callbacks of subscriptions may return `HANDED_OVER`."""

    def __init__(self, context: Context) -> None:
        super().__init__(context=context)
        self._entities: _Entities | None = None
        self._changed = True
        self.stands = True
        self._handed_over_s = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for an event and handle it; raises ExternalShutdownException, see rclpy."""
        received: list[Received] = []
        try:
            received = self._wait(timeout_sec) if self.stands else []
        except PARTS_MISSING as error:
            self._fall_back(error)
        if not self.stands:
            super().spin_once(timeout_sec)
            return
        # Before anything else: a peer may be waiting for the answer to a message.
        self._call(received)
        if received:  # taking what arrived meanwhile costs less than a wait
            self._call(self._come())
        due = list[Any]()
        left = False
        try:
            # a callback may have shut down the executor or its context
            if self._entities is not None and self.context.ok():
                woken, others = self._entities.others_ready(self._guard)
                # the executor is also woken when an entity is added to a node
                self._changed |= woken or others
                due = self._entities.due()
                # rclpy also wakes it after each callback; then there is nothing to handle.
                left = others or (woken and bool(self._tasks))
        except PARTS_MISSING as error:
            self._fall_back(error)
        # The callbacks may have destroyed entities, which must leave the wait set.
        self._changed |= bool(due)
        for timer in due:
            self._tick(timer)
        if left:  # a message sent before a request must also be handled before it
            self._call(self._come())
            self._handle_others()

    def _wait(self, timeout_sec: float | None) -> list[Received]:
        try:
            entities = self._gathered()
            entities.wait(-1 if timeout_sec is None else int(timeout_sec * NS_PER_S))
        except RuntimeError:
            # raised by the library if another thread has shut down the context
            if self.context.ok():
                raise
        if not self.context.ok():
            raise ExternalShutdownException
        return entities.taken()

    def _come(self) -> list[Received]:
        # a callback may have shut down the executor or its context
        if self._entities is None or not self.context.ok():
            return []
        return self._entities.come()

    def _call(self, received: Iterable[Received]) -> None:
        handed_over = False
        for callback, arguments in received:
            handed_over |= callback(*arguments) is HANDED_OVER
        if handed_over:
            before_s = self._handed_over_s
            self._handed_over_s = time.monotonic()
            time.sleep(min(REST * (self._handed_over_s - before_s), LONGEST_REST_S))

    def _tick(self, timer: Any) -> None:
        if not self.context.ok() or not any(
            timer in node.timers for node in self.get_nodes()
        ):
            return
        try:
            if not timer.handle.is_timer_ready():
                return
            timer.handle.call_timer()  # restarts its period
        except PARTS_MISSING as error:
            self._fall_back(error)
            return
        timer.callback()

    def _fall_back(self, error: Exception) -> None:
        self.stands = False
        self._release()
        get_logger("executor").warning(
            f"this rclpy needs its own, slower executor ({error})"
        )

    def _handle_others(self) -> None:
        with contextlib.suppress(TimeoutException):
            for _ in range(MOST_AT_ONCE):
                if not self.context.ok():  # a callback may have shut it down
                    raise ExternalShutdownException
                task, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
                task()
                task.result()  # re-raises the callback's exception

    def _gathered(self) -> "_Entities":
        nodes = self.get_nodes() if self._changed else []
        now = self._entities
        if now is None or (self._changed and now.all != _entities_of(nodes)):
            self._release()
            guards = [guard for guard in (self._guard, self._sigint_gc) if guard]
            now = self._entities = _Entities(self.get_nodes(), guards, self.context)
        self._changed = False
        return now

    def _release(self) -> None:
        if self._entities is not None:
            self._entities.opened.close()
            self._entities = None

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Release all entities; see rclpy."""
        self._release()
        return bool(super().shutdown(timeout_sec))


class _Entities:
    def __init__(
        self, nodes: Sequence[Node], guards: Sequence[Any], context: Context
    ) -> None:
        self.all = _entities_of(nodes)
        subscriptions, others, timers, clients, services, self._waitables = self.all
        # A subscription's callback takes the message, or also its info.
        self._subscriptions = []
        for subscription in subscriptions:
            count = 1 if _takes(subscription.callback, None) else 2
            self._subscriptions.append((subscription, count))
        self._timers = {
            timer.handle.pointer: timer
            for timer in timers
            if _takes(timer.callback)
            and not inspect.iscoroutinefunction(timer.callback)
        }
        kinds = {
            "subscription": subscriptions,
            "guard_condition": (*guards, *others),
            "timer": timers,
            "client": clients,
            "service": services,
        }
        self.opened = ExitStack()
        for entity in itertools.chain(*kinds.values()):
            self.opened.enter_context(entity.handle)
        for waitable in self._waitables:
            self.opened.enter_context(waitable)
        self.opened.enter_context(context.handle)
        room = NumberOfEntities(*map(len, kinds.values()))
        for waitable in self._waitables:
            room += waitable.get_num_entities()
        self._wait_set = rclpy_implementation.WaitSet(
            room.num_subscriptions,
            room.num_guard_conditions,
            room.num_timers,
            room.num_clients,
            room.num_services,
            room.num_events,
            context.handle,
        )
        self._adding = []
        for kind, entities in kinds.items():
            add = getattr(self._wait_set, f"add_{kind}")
            self._adding += [(add, entity.handle) for entity in entities]

    def wait(self, timeout_ns: int) -> None:
        self._wait_set.clear_entities()  # each wait drops those that were not ready
        for add, handle in self._adding:
            add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._wait_set.wait(timeout_ns)

    def taken(self) -> list[Received]:
        is_ready = self._wait_set.is_ready
        entries = enumerate(self._subscriptions)
        return _take(entry for i, entry in entries if is_ready("subscription", i))

    def come(self) -> list[Received]:
        return _take(self._subscriptions)

    def due(self) -> list[Any]:
        ready = self._wait_set.get_ready_entities("timer")
        return [self._timers[pointer] for pointer in ready if pointer in self._timers]

    def others_ready(self, wake_up: Any) -> tuple[bool, bool]:
        """Return whether the executor was woken, and whether rclpy has to handle something."""
        ready = self._wait_set.get_ready_entities
        triggered = list(ready("guard_condition"))
        for guard in self.all[1]:
            if guard.handle.pointer in triggered:
                # Waiting has reset the flag; rclpy needs it.
                guard._executor_triggered = True
        woken = wake_up is not None and wake_up.handle.pointer in triggered
        if woken:
            triggered.remove(wake_up.handle.pointer)
        others = bool(triggered or ready("client") or ready("service"))
        others = others or not self._timers.keys() >= set(ready("timer"))
        for waitable in self._waitables:
            others = others or waitable.is_ready(self._wait_set)
        return woken, others


def _take(subscriptions: Iterable[tuple[Any, int]]) -> list[Received]:
    received = []
    for subscription, arguments in subscriptions:
        try:
            taken = subscription.handle.take_message(
                subscription.msg_type, subscription.raw
            )
        except InvalidHandle:  # a callback has destroyed it
            continue
        if taken is not None:
            received.append((subscription.callback, taken[:arguments]))
    return received


def _takes(callback: Any, *arguments: Any) -> bool:
    try:
        inspect.signature(callback).bind(*arguments)
    except TypeError:
        return False
    return True


def _entities_of(nodes: Sequence[Node]) -> tuple[tuple[Any, ...], ...]:
    kinds = ("subscriptions", "guards", "timers", "clients", "services", "waitables")
    entities = []
    for kind in kinds:
        of_nodes = (getattr(node, kind) for node in nodes)
        entities.append(tuple(itertools.chain.from_iterable(of_nodes)))
    return tuple(entities)
