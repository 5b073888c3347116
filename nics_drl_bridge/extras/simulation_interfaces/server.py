"""The server: every service of the standard, and the features that stand behind them."""

import re
from collections.abc import Callable
from typing import Any, NoReturn

from simulation_interfaces import srv
from simulation_interfaces.msg import Result, SimulatorFeatures

from nics_drl_bridge.extras.simulation_interfaces.entities import (
    FORMATS,
    EntityServices,
)
from nics_drl_bridge.extras.simulation_interfaces.state import (
    Handler,
    RefusalError,
    Simulation,
    served,
)

FEATURES = (
    "SPAWNING",
    "DELETING",
    "SPAWNING_RESOURCE_STRING",
    "ENTITY_STATE_GETTING",
    "ENTITY_STATE_SETTING",
    "SIMULATION_RESET",
    "SIMULATION_RESET_TIME",
    "SIMULATION_RESET_STATE",
    "SIMULATION_RESET_SPAWNED",
    "SIMULATION_STATE_GETTING",
    "SIMULATION_STATE_SETTING",
    "SIMULATION_STATE_PAUSE",
    "STEP_SIMULATION_SINGLE",
    "STEP_SIMULATION_MULTIPLE",
    "WORLD_LOADING",
    "WORLD_INFO_GETTING",
)
UNSUPPORTED = (
    "GetAvailableWorlds",
    "GetEntityBounds",
    "GetEntityInfo",
    "GetNamedPoseBounds",
    "GetNamedPoses",
    "GetSpawnables",
    "SetEntityInfo",
    "SpawnEntities",
    "UnloadWorld",
)
ABOUT = "nics_drl_bridge: a 2-D world of shapes and robots of one kind; docs/simulator_node.md"


def snake_case(name: str) -> str:
    """Return the name of a service as all simulators write it: `get_entities`."""
    return re.sub("(?<!^)(?=[A-Z])", "_", name).lower()


class Server:
    """Offers the services at a device node, below its namespace, for as long as that lives."""

    def __init__(self, host: Any) -> None:
        self._host = host
        simulation = Simulation(host)
        entities = EntityServices(host, simulation)
        handlers: dict[str, Handler] = {
            **dict.fromkeys(UNSUPPORTED, _refuse),
            "GetSimulationState": simulation.get_state,
            "SetSimulationState": simulation.set_state,
            "ResetSimulation": simulation.reset,
            "StepSimulation": simulation.step,
            "LoadWorld": simulation.load_world,
            "GetCurrentWorld": simulation.get_world,
            "GetEntities": entities.list_names,
            "GetEntitiesStates": entities.list_states,
            "GetEntityState": entities.get_state,
            "SetEntityState": entities.set_state,
            "DeleteEntity": entities.delete,
            "SpawnEntity": entities.spawn,
        }
        for name, handler in handlers.items():
            self._offer(name, served(handler, host))
        self._offer("GetSimulatorFeatures", self._tell)

    def _offer(self, name: str, reply: Callable[[Any, Any], Any]) -> None:
        self._host.create_service(getattr(srv, name), snake_case(name), reply)

    @staticmethod
    def _tell(_: Any, response: Any) -> Any:
        features: SimulatorFeatures = response.features
        features.features = [getattr(features, name) for name in FEATURES]
        features.spawn_formats = FORMATS
        features.custom_info = ABOUT
        return response


def _refuse(*_: Any) -> NoReturn:
    reason = "this is not supported here; see get_simulator_features."
    raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, reason)
