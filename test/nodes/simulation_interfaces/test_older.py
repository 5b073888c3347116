"""An older version of the standard's messages stops nobody."""

import sys
from types import ModuleType, SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")

from nics_drl_bridge.extras import simulation_interfaces as standard


@pytest.fixture(params=["1.x", "2.0"])
def older(request, monkeypatch):
    """Messages of another version, in place of those that may be installed."""
    package = ModuleType("simulation_interfaces")
    kinds = ModuleType("simulation_interfaces.srv")
    package.__path__ = []
    kinds.GetSimulatorFeatures = object
    if request.param == "2.0":
        kinds.LoadWorld = object
    for module in (package, kinds):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    for name in ("msg", "action"):
        monkeypatch.setitem(sys.modules, f"simulation_interfaces.{name}", None)
    server = "nics_drl_bridge.extras.simulation_interfaces.server"
    for name in [each for each in sys.modules if each.startswith(server)]:
        monkeypatch.delitem(sys.modules, name)


def test_a_simulator_goes_on_without_the_services_and_tells_why(older):
    said = []
    node = SimpleNamespace(
        has_parameter=lambda _: True,
        get_parameter=lambda _: SimpleNamespace(value=True),
        get_logger=lambda: SimpleNamespace(info=said.append),
    )
    assert standard.open_services(node) is None
    (line,) = said
    assert "2.1 or newer, is not installed" in line
