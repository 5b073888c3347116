"""The server: every service of the standard, and the features that stand behind them."""

import re
from collections.abc import Callable
from typing import Any, NoReturn

from rclpy.action import ActionServer, CancelResponse
from simulation_interfaces.msg import Result, SimulatorFeatures

from nics_drl_bridge.extras.simulation_interfaces.entities import EntityServices
from nics_drl_bridge.extras.simulation_interfaces.host import (
    Handler,
    RefusalError,
    served,
)
from nics_drl_bridge.extras.simulation_interfaces.spawning import FORMATS, Spawning
from nics_drl_bridge.extras.simulation_interfaces.state import Simulation
from nics_drl_bridge.extras.simulation_interfaces.worlds import Worlds
from nics_drl_bridge.nodes import conversions

PACKAGE = "simulation_interfaces"
FEATURES = (
    "SPAWNING",
    "DELETING",
    "ENTITY_BOUNDS",
    "ENTITY_CATEGORIES",
    "SPAWNING_RESOURCE_STRING",
    "ENTITY_STATE_GETTING",
    "ENTITY_STATE_SETTING",
    "ENTITY_INFO_GETTING",
    "SPAWNABLES",
    "SIMULATION_RESET",
    "SIMULATION_RESET_TIME",
    "SIMULATION_RESET_STATE",
    "SIMULATION_RESET_SPAWNED",
    "SIMULATION_STATE_GETTING",
    "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE",
    "STEP_SIMULATION_MULTIPLE",
    "STEP_SIMULATION_ACTION",
    "WORLD_LOADING",
    "WORLD_RESOURCE_STRING",
    "WORLD_INFO_GETTING",
    "AVAILABLE_WORLDS",
)
ABOUT = "nics_drl_bridge: a 2-D world of shapes and robots of one kind; docs/simulator_node.md"


def snake_case(name: str) -> str:
    """Return the name of a service as all simulators write it: `get_entities`."""
    return re.sub("(?<!^)(?=[A-Z])", "_", name).lower()


class Server:
    """Offers the services at a device node, below its namespace, for as long as that lives."""

    def __init__(self, host: Any) -> None:
        self._host = host
        self._simulation = Simulation(host)
        simulation = self._simulation
        entities = EntityServices(host, simulation)
        spawning = Spawning(host, simulation, entities)
        worlds = Worlds(host, simulation)
        handlers: dict[str, Handler] = {
            "GetSimulationState": simulation.get_state,
            "SetSimulationState": simulation.set_state,
            "ResetSimulation": simulation.reset,
            "StepSimulation": simulation.step,
            "GetEntities": entities.list_names,
            "GetEntitiesStates": entities.list_states,
            "GetEntityInfo": entities.get_info,
            "GetEntityState": entities.get_state,
            "SetEntityState": entities.set_state,
            "GetEntityBounds": entities.get_bounds,
            "DeleteEntity": entities.delete,
            "SpawnEntity": spawning.spawn,
            "SpawnEntities": _refuse,
            "GetSpawnables": spawning.list_spawnables,
            "LoadWorld": worlds.load,
            "UnloadWorld": _refuse,
            "GetCurrentWorld": worlds.current,
            "GetAvailableWorlds": worlds.available,
            "SetEntityInfo": _refuse,
            "GetNamedPoses": _refuse,
            "GetNamedPoseBounds": _refuse,
        }
        for name, handler in handlers.items():
            self._offer(name, served(handler, host))
        self._offer("GetSimulatorFeatures", self._tell)
        kind = conversions.message_type(f"{PACKAGE}/action/SimulateSteps")
        if kind:
            self._action = ActionServer(
                host,
                kind,
                "simulate_steps",
                simulation.simulate,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )

    def _offer(self, name: str, reply: Callable[[Any, Any], Any]) -> None:
        kind = conversions.message_type(f"{PACKAGE}/srv/{name}")
        if kind is not None:  # in an older version of the standard there are fewer
            self._host.create_service(kind, snake_case(name), reply)

    @staticmethod
    def _tell(_: Any, response: Any) -> Any:
        features: SimulatorFeatures = response.features
        features.features = [
            getattr(features, name) for name in FEATURES if hasattr(features, name)
        ]
        features.spawn_formats = FORMATS
        features.custom_info = ABOUT
        return response


def _refuse(*_: Any) -> NoReturn:
    reason = "this is not supported here; see get_simulator_features."
    raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, reason)
