import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from nics_drl_bridge.nodes import executor as executor_module
from nics_drl_bridge.nodes.executor import HANDED_OVER, StandingExecutor
from nics_drl_bridge.nodes.listener import open_context

pytestmark = pytest.mark.ros
SPINS = 2000


@pytest.fixture
def node(domain_id):
    context = open_context(domain_id=domain_id)
    made = Node("standing", context=context, start_parameter_services=False)
    yield made
    made.destroy_node()
    context.try_shutdown()


@pytest.fixture
def executor(node):
    made = StandingExecutor(node.context)
    made.add_node(node)
    yield made
    made.shutdown(timeout_sec=1.0)


def spin_until(executor, done, what):
    for _ in range(SPINS):
        if done():
            return
        executor.spin_once(timeout_sec=0.02)
    raise AssertionError(f"never: {what}")


def test_entities_that_come_and_go_are_noticed(node, executor):
    publisher = node.create_publisher(Int32, "count", 10)
    one = []
    two = []
    first = node.create_subscription(Int32, "count", one.append, 10)
    spin_until(executor, lambda: publisher.get_subscription_count() == 1, "matched")
    publisher.publish(Int32(data=1))
    spin_until(executor, lambda: one == [Int32(data=1)], "the first message")
    node.create_subscription(Int32, "count", two.append, 10)
    node.destroy_subscription(first)
    spin_until(
        executor, lambda: publisher.get_subscription_count() == 1, "matched again"
    )
    publisher.publish(Int32(data=2))
    spin_until(executor, lambda: two == [Int32(data=2)], "the message of the second")
    assert one == [Int32(data=1)]


def test_services_clients_timers_and_guard_conditions_are_served_beside(node, executor):
    def answer(_, response):
        response.success = True
        return response

    ticks = []
    triggered = []
    node.create_service(Trigger, "ask", answer)
    client = node.create_client(Trigger, "ask")
    node.create_timer(0.01, lambda: ticks.append(1))
    guard = node.create_guard_condition(lambda: triggered.append(1))
    spin_until(executor, client.service_is_ready, "the service")
    future = client.call_async(Trigger.Request())
    called_back = []
    future.add_done_callback(called_back.append)
    guard.trigger()
    spin_until(
        executor, lambda: called_back and triggered and len(ticks) > 5, "all served"
    )
    assert future.result().success


def test_a_callback_that_asks_for_it_is_told_about_the_message(node, executor):
    publisher = node.create_publisher(Int32, "count", 10)
    told = []
    node.create_subscription(
        Int32, "count", lambda data, info: told.append((data, info)), 10, raw=True
    )
    spin_until(executor, lambda: publisher.get_subscription_count() == 1, "matched")
    publisher.publish(Int32(data=1))
    spin_until(executor, lambda: told, "the message")
    data, info = told[0]
    assert isinstance(data, bytes)
    assert info["received_timestamp"] > 0


def test_it_rests_for_a_part_of_the_time_since_it_last_did_but_no_longer_than_a_limit(
    executor, monkeypatch
):
    now_s = [0.0]
    rests = []
    monkeypatch.setattr(executor_module.time, "sleep", rests.append)
    monkeypatch.setattr(executor_module.time, "monotonic", lambda: now_s[0])
    for now_s[0] in (1.0, 1.001, 2.0):
        executor._call([(lambda: HANDED_OVER, ())])
    longest = executor_module.LONGEST_REST_S
    assert rests == pytest.approx([longest, executor_module.REST * 0.001, longest])


def test_it_rests_after_a_callback_that_woke_another_thread_and_after_no_other(
    node, executor, monkeypatch
):
    answers = [None, True, HANDED_OVER]
    rests = []
    heard = []

    def hear(message):
        heard.append(message.data)
        return answers[message.data]

    monkeypatch.setattr(executor_module.time, "sleep", rests.append)
    publisher = node.create_publisher(Int32, "count", 10)
    node.create_subscription(Int32, "count", hear, 10)
    spin_until(executor, lambda: publisher.get_subscription_count() == 1, "matched")
    for number, answer in enumerate(answers):
        publisher.publish(Int32(data=number))
        spin_until(
            executor, lambda number=number: heard[-1:] == [number], "the message"
        )
        assert bool(rests) == (answer is HANDED_OVER)
        rests.clear()


@pytest.mark.parametrize("part", ["taken", "wait"])
def test_with_an_rclpy_that_lacks_a_part_it_is_rclpys_own(
    node, executor, part, monkeypatch, capfd
):
    def lack(*_):
        raise AttributeError(part)

    publisher = node.create_publisher(Int32, "count", 10)
    heard = []
    ticks = []
    node.create_subscription(Int32, "count", heard.append, 10)
    node.create_timer(0.01, lambda: ticks.append(1))
    spin_until(executor, lambda: publisher.get_subscription_count() == 1, "matched")
    monkeypatch.setattr(executor_module._Entities, part, lack)
    publisher.publish(Int32(data=1))
    spin_until(executor, lambda: heard and len(ticks) > 3, "served by rclpy's")
    assert not executor.stands
    assert heard == [Int32(data=1)]
    assert capfd.readouterr().err.count("slower executor") == 1


def test_a_timer_ticks_as_often_as_it_is_due_beside_messages(node, executor):
    publisher = node.create_publisher(Int32, "count", 10)
    heard = []
    ticks = []

    def tick():
        ticks.append(1)
        publisher.publish(Int32())

    node.create_subscription(Int32, "count", heard.append, 10)
    timer = node.create_timer(0.005, tick)
    spin_until(
        executor, lambda: len(ticks) > 20 and len(heard) > 5, "ticks and messages"
    )
    assert timer.time_until_next_call() <= 5_000_000


def test_a_timer_that_is_cancelled_or_destroyed_by_another_does_not_tick(
    node, executor
):
    ticks = []
    others = []

    def first():
        ticks.append(1)
        cancelled.cancel()
        node.destroy_timer(destroyed)

    node.create_timer(0.01, first)
    cancelled = node.create_timer(0.01, lambda: others.append("cancelled"))
    destroyed = node.create_timer(0.01, lambda: others.append("destroyed"))
    spin_until(executor, lambda: len(ticks) > 10, "ticks")
    assert others == []


def test_timers_whose_callback_is_awaited_are_left_to_rclpy(node, executor):
    awaited = []

    async def tick():
        awaited.append(1)

    node.create_timer(0.005, tick)
    spin_until(executor, lambda: len(awaited) > 3, "awaited ticks")
