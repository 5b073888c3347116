"""An executor that keeps its wait set: 1.5 times as many lock-step steps per second as rclpy's."""

import contextlib
import inspect
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
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
HANDED_OVER, REST, LONGEST_REST_S = object(), 0.4, 1e-3
"""Returned by a callback that has woken another thread of this process. The executor then rests, to
leave the processor to that thread, for a fraction of the time since it last rested, at most for
LONGEST_REST_S."""
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
        asked = list[Callable[[], object]]()
        left = False
        try:
            # a callback may have shut down the executor or its context
            if self._entities is not None and self.context.ok():
                asked = self._entities.asked()
                woken, others = self._entities.others_ready(self._guard)
                # the executor is also woken when an entity is added to a node
                self._changed |= woken or others
                # rclpy also wakes it after each callback; then there is nothing to handle.
                due, left = (
                    self._entities.due(),
                    others or (woken and bool(self._tasks)),
                )
        except PARTS_MISSING as error:
            self._fall_back(error)
        if asked:  # a message sent before a request must also be handled before it
            self._call(self._come())
        for answer in asked:
            answer()
        # The callbacks may have destroyed entities, which must leave the wait set.
        self._changed |= bool(asked or due)
        for timer in due:
            self._tick(timer)
        if left:
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
        self._subscriptions = [
            (s, 1 if _takes(s.callback, None) else 2) for s in subscriptions
        ]
        self._clients = {one.handle.pointer: one for one in clients}
        self._services, self._timers = (
            {
                e.handle.pointer: e
                for e in each
                if not inspect.iscoroutinefunction(e.callback)
            }
            for each in (services, [one for one in timers if _takes(one.callback)])
        )
        self._own = {*self._timers, *self._services, *self._clients}
        kinds = subscriptions, (*guards, *others), timers, clients, services
        self.opened = ExitStack()
        handles = (one.handle for one in itertools.chain(*kinds))
        for held in (*handles, *self._waitables, context.handle):
            self.opened.enter_context(held)
        room = NumberOfEntities(*(len(each) for each in kinds))
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
        names = ("subscription", "guard_condition", "timer", "client", "service")
        self._adding = [
            (getattr(self._wait_set, f"add_{name}"), one.handle)
            for name, each in zip(names, kinds, strict=True)
            for one in each
        ]

    def wait(self, timeout_ns: int) -> None:
        self._wait_set.clear_entities()  # each wait drops those that were not ready
        for add, handle in self._adding:
            add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._wait_set.wait(timeout_ns)

    def taken(self) -> list[Received]:
        is_ready = self._wait_set.is_ready
        found = enumerate(self._subscriptions)
        return _take(entry for i, entry in found if is_ready("subscription", i))

    def come(self) -> list[Received]:
        return _take(self._subscriptions)

    def asked(self) -> list[Callable[[], object]]:
        """Take requests to services and answers to clients; return how each is handled."""
        ready = self._wait_set.get_ready_entities
        found = list[Callable[[], object]]()
        for service in _known(self._services, ready("service")):
            request, header = service.handle.service_take_request(
                service.srv_type.Request
            )
            if header is not None:
                found.append(partial(_serve, service, request, header))
        for client in _known(self._clients, ready("client")):
            header, response = client.handle.take_response(client.srv_type.Response)
            if header is not None:
                found.append(
                    partial(
                        _answer, client, header.request_id.sequence_number, response
                    )
                )
        return found

    def due(self) -> list[Any]:
        return _known(self._timers, self._wait_set.get_ready_entities("timer"))

    def others_ready(self, own: Any) -> tuple[bool, bool]:
        ready = self._wait_set.get_ready_entities
        triggered = list(ready("guard_condition"))
        for guard in self.all[1]:
            if guard.handle.pointer in triggered:
                # Waiting has reset the flag; rclpy needs it.
                guard._executor_triggered = True
        woken = own is not None and own.handle.pointer in triggered
        if woken:
            triggered.remove(own.handle.pointer)
        others = bool(triggered) or any(
            one not in self._own
            for kind in ("client", "service", "timer")
            for one in ready(kind)
        )
        return woken, others or any(
            each.is_ready(self._wait_set) for each in self._waitables
        )


def _known(entities: Mapping[int, Any], pointers: Iterable[int]) -> list[Any]:
    return [entities[pointer] for pointer in pointers if pointer in entities]


def _serve(service: Any, request: Any, header: Any) -> None:
    service.send_response(
        service.callback(request, service.srv_type.Response()), header
    )


def _answer(client: Any, number: int, response: Any) -> None:
    with contextlib.suppress(KeyError):  # nobody waits for it any more
        client.get_pending_request(number).set_result(response)


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
    return tuple(
        tuple(one for node in nodes for one in getattr(node, kind)) for kind in kinds
    )
