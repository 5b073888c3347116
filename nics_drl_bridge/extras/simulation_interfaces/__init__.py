"""The standard services of simulators, simulation_interfaces, where its messages are installed."""

from typing import TYPE_CHECKING, Any

from nics_drl_bridge.nodes import conversions, runner

# This service exists since simulation_interfaces 2.1, the oldest supported version.
NEWEST = "simulation_interfaces/srv/SpawnEntities"

if TYPE_CHECKING:
    from nics_drl_bridge.extras.simulation_interfaces.server import Server


def open_services(node: Any) -> "Server | None":
    """Offer the standard services at a device node; None without its messages, or if unwanted."""
    if not runner.get_flag(node, "simulation_interfaces"):
        return None
    if conversions.find_message_type(NEWEST) is None:
        node.get_logger().info(
            "the package simulation_interfaces, 2.1 or newer, is not installed, so that its "
            "services are not offered"
        )
        return None
    from nics_drl_bridge.extras.simulation_interfaces.server import Server

    return Server(node)
