import pytest
from rclpy.exceptions import ParameterException
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from std_msgs.msg import Bool

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.nodes import qos
from nics_drl_bridge.nodes.runner import explain_ignored_values

pytestmark = pytest.mark.ros


@pytest.fixture
def overridden(make_node):
    """Makes nodes with overrides, as `overridden("/scan.publisher.depth:=3")`."""

    def make(*overrides, remap=()):
        given = [f"qos_overrides.{each}" for each in overrides]
        return make_node(*given, words=[w for each in remap for w in ("-r", each)])

    return make


def test_overrides_of_a_publisher_and_a_subscription_are_honoured(overridden):
    node = overridden(
        "/scan.publisher.reliability:=best_effort",
        "/scan.publisher.depth:=3",
        "/scan.subscription.durability:=transient_local",
        "/scan.subscription.deadline:=1000000",
    )
    publisher = node.create_publisher(Bool, "scan", qos.SENSOR_RELIABLE)
    heard = node.create_subscription(Bool, "scan", lambda _: None, qos.SENSOR)
    (offered,) = node.get_publishers_info_by_topic("/scan")
    (asked,) = node.get_subscriptions_info_by_topic("/scan")
    assert offered.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert publisher.qos_profile.depth == 3
    assert asked.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert heard.qos_profile.depth == qos.SENSOR.depth
    assert heard.qos_profile.deadline.nanoseconds == 1_000_000
    assert node.get_parameter("qos_overrides./scan.publisher.depth").value == 3


def test_an_override_of_one_topic_leaves_the_others_as_they_are(overridden):
    node = overridden("/scan.publisher.depth:=3")
    node.create_publisher(Bool, "scan", qos.SENSOR_RELIABLE)
    other = node.create_publisher(Bool, "odom", qos.SENSOR_RELIABLE)
    assert other.qos_profile.depth == qos.SENSOR_RELIABLE.depth == 10
    assert not node.get_parameters_by_prefix("qos_overrides./odom")


@pytest.mark.parametrize("topic", qos.FIXED_TOPICS)
@pytest.mark.parametrize("name", ["same", "elsewhere"])
def test_the_quality_of_service_that_a_stop_depends_on_can_not_be_overridden(
    overridden, topic, name
):
    final = topic if name == "same" else name
    node = overridden(f"/{final}.subscription.depth:=1", remap=[f"{topic}:={final}"])
    with pytest.raises(
        ConfigError, match=rf"qos_overrides./{final}.subscription.depth.*leave it"
    ):
        node.create_subscription(Bool, topic, lambda _: None, qos.EVERY_COMMAND)


@pytest.mark.parametrize(
    "override", ["reliability:=best_efort", "depth:=many", "depth:=-1"]
)
def test_an_override_that_can_not_be_is_refused_with_its_topic(overridden, override):
    node = overridden(f"/scan.publisher.{override}")
    with pytest.raises((ConfigError, ParameterException), match="scan"):
        node.create_publisher(Bool, "scan", qos.SENSOR_RELIABLE)


def test_a_policy_that_does_not_exist_is_ignored_with_a_sentence(overridden):
    node = overridden("/scan.publisher.reliabilty:=reliable")
    node.create_publisher(Bool, "scan", qos.SENSOR_RELIABLE)
    (line,) = explain_ignored_values(node)
    assert "'qos_overrides./scan.publisher.reliabilty' is ignored" in line
