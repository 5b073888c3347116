"""State of the simulation: playing, paused, stopped; steps, and resets."""

from collections.abc import Generator
from typing import Any

from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Result, SimulationState
from simulation_interfaces.srv import ResetSimulation, SetSimulationState

from nics_drl_bridge.errors import BridgeError
from nics_drl_bridge.extras.simulation_interfaces.host import (
    Host,
    RefusalError,
    outcome,
)
from nics_drl_bridge.nodes import runner
from nics_drl_bridge.sim.entities import Entities

STOPPED = SimulationState.STATE_STOPPED
PLAYING = SimulationState.STATE_PLAYING
PAUSED = SimulationState.STATE_PAUSED
QUITTING = SimulationState.STATE_QUITTING
NAMES = {STOPPED: "stopped", PLAYING: "playing", PAUSED: "paused", QUITTING: "quitting"}
MOST_STEPS = 100_000  # of one call of a service, which answers nothing else meanwhile
GOODBYE_S = 0.2  # until the answer to who ended the simulation has left
SCOPES = ResetSimulation.Request
EVERY_SCOPE = SCOPES.SCOPE_TIME | SCOPES.SCOPE_STATE | SCOPES.SCOPE_SPAWNED


class Turn:
    """Lets the executor handle all else before a coroutine goes on."""

    def __await__(self) -> Generator[None, None, None]:
        yield


class Simulation:
    """The state of a device node's simulation, and the services around it."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._stepping = False
        self._halted = STOPPED  # or paused, or quitting, while the host is paused
        self._turn: Any = host.create_guard_condition(lambda: None)
        self.renew()

    def renew(self) -> None:
        """List the entities of a world that the host begins to simulate."""
        host = self._host
        self.entities = Entities(
            host.device, host.world, host.robot_names, host.make_simulator
        )

    @property
    def state(self) -> int:
        """Constant of SimulationState; who pauses the node by its own service pauses it too."""
        if not self._host.paused:
            self._halted = PAUSED
            return int(PLAYING)
        return int(self._halted)

    def halt(self, state: int) -> None:
        """Hold the simulation in a state other than playing."""
        self._host.pause(True)
        self._halted = state
        self._stepping = False

    def get_state(self, _: Any, response: Any) -> None:
        """Answer GetSimulationState."""
        response.state.state = self.state

    def set_state(self, request: Any, _: Any) -> None:
        """Answer SetSimulationState."""
        codes = SetSimulationState.Response
        wanted = request.state.state
        state = self.state
        if wanted == state:
            already = f"the simulation is {NAMES[state]} already."
            raise RefusalError(codes.ALREADY_IN_TARGET_STATE, already)
        if wanted not in NAMES:
            states = ", ".join(f"{value} ({name})" for value, name in NAMES.items())
            fault = f"state {wanted} can't be set; choose one of {states}."
            raise RefusalError(codes.INCORRECT_TRANSITION, fault)
        if wanted == QUITTING:
            self.halt(QUITTING)
            runner.steadily(self._host, GOODBYE_S, self._host.context.try_shutdown)
            return
        if wanted == STOPPED:
            try:
                self._reset_all()
            except BridgeError as error:
                self.halt(PAUSED)
                fault = f"it did not stop: {error}"
                raise RefusalError(codes.STATE_TRANSITION_ERROR, fault) from None
        self._stepping = False
        if wanted == PLAYING:
            self._host.pause(False)
        else:
            self.halt(wanted)

    def require_paused(self, steps: int) -> None:
        """Raise RefusalError unless so many steps can be made now."""
        problem = ""
        if self.state != PAUSED:
            problem = "the simulation is not paused; set its state to paused first."
        elif self._stepping:
            problem = "steps of simulate_steps are being made; wait for their end, or cancel them."
        elif steps < 1:
            problem = "steps is 0; ask for 1 or more."
        if problem:
            raise RefusalError(Result.RESULT_OPERATION_FAILED, problem)

    def step(self, request: Any, _: Any) -> None:
        """Answer StepSimulation."""
        self.require_paused(request.steps)
        if request.steps > MOST_STEPS:
            fault = (
                f"steps is {request.steps}, and {MOST_STEPS} are the most of one call"
            )
            raise RefusalError(
                Result.RESULT_OPERATION_FAILED, f"{fault}; use simulate_steps."
            )
        for _ in range(request.steps):
            self._host.step()

    async def simulate(self, goal: Any) -> Any:
        """Execute SimulateSteps: one step at a turn, so that all else is answered meanwhile."""
        steps = goal.request.steps
        result = SimulateSteps.Result()
        result.result.result = Result.RESULT_OPERATION_FAILED
        try:
            self.require_paused(steps)
        except RefusalError as error:
            result.result.error_message = str(error)
            goal.abort()
            return result
        self._stepping = True
        done = 0
        why = ""
        try:
            while done < steps and not why:
                _, why = outcome(self._host.step, self._host)
                if why:
                    break
                done += 1
                goal.publish_feedback(
                    SimulateSteps.Feedback(
                        completed_steps=done, remaining_steps=steps - done
                    )
                )
                self._turn.trigger()
                await Turn()
                why = self._interrupted(goal, done, steps)
        finally:
            self._stepping = False
        result.result.error_message = why
        if done == steps:
            result.result.result = Result.RESULT_OK
            result.result.error_message = ""
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _interrupted(self, goal: Any, done: int, steps: int) -> str:
        if goal.is_cancel_requested:
            return f"cancelled after {done} of {steps} steps."
        if self.state != PAUSED or not self._stepping:
            return (
                f"the simulation was changed after {done} of {steps} steps; ask again."
            )
        return ""

    def reset(self, request: Any, _: Any) -> None:
        """Answer ResetSimulation."""
        scope = request.scope or SCOPES.SCOPE_ALL
        if not scope & EVERY_SCOPE or (
            scope & ~EVERY_SCOPE and scope != SCOPES.SCOPE_ALL
        ):
            bits = "1 (time), 2 (state) and 4 (spawned)"
            fault = f"scope {scope} has bits that mean nothing; add up {bits}, or give 0 for all."
            raise RefusalError(Result.RESULT_FEATURE_UNSUPPORTED, fault)
        self._stepping = False
        if scope & EVERY_SCOPE == EVERY_SCOPE:
            self._reset_all()
            return
        if scope & SCOPES.SCOPE_SPAWNED:
            if set(self.entities.robot_names) <= self.entities.spawned.keys():
                fault = "a simulator needs a robot, and all were spawned; reset all, by scope 0."
                raise RefusalError(Result.RESULT_OPERATION_FAILED, fault)
            self.remove(*self.entities.spawned)
        if scope & SCOPES.SCOPE_STATE:
            self._host.begin(rewind=bool(scope & SCOPES.SCOPE_TIME))
        elif scope & SCOPES.SCOPE_TIME:
            self._host.rewind()

    def restore(self) -> None:
        """Remove what was spawned, and bring back what was deleted."""
        # A robot that was spawned may have the name of one that was deleted.
        changed = any(entity.robot >= 0 for entity in self.entities.spawned.values())
        changed |= self.entities.robot_names != list(self._host.robot_names)
        self.entities.restore()
        if changed:
            self._host.reopen_robots()

    def _reset_all(self) -> None:
        self.restore()
        self._host.begin(rewind=True)

    def remove(self, *names: str) -> None:
        """Remove entities, and the topics of robots among them."""
        for name in names:
            entity = self.entities.find(name)
            self.entities.delete(entity)
            if entity.robot >= 0:
                self._host.remove_robots([entity.robot])
