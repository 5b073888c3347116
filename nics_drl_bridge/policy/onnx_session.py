"""Opens a policy's graph in onnxruntime after all checks; imports little, see `rehearsal`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.policy import onnx_graph

Rows = NDArray[np.float32]


@dataclass(frozen=True)
class GraphNeeds:
    """What a policy file states about its graph, as plain data."""

    observation: int  # size of an observation
    commands: int  # number of commands
    discrete: bool  # True: each action is an integer
    batch: int | None  # maximum number of observations per run; None: no maximum
    graph_sha256: str
    # size and start value of the state; None: the policy has no state
    state: tuple[int, float] | None = None

    @property
    def widths(self) -> dict[str, int | None]:
        """Widths of inputs and outputs; None: integers, one per row."""
        widths: dict[str, int | None] = {
            onnx_graph.INPUT: self.observation,
            onnx_graph.COMMAND: self.commands,
            onnx_graph.ACTION: None if self.discrete else self.commands,
        }
        if self.state is not None:
            ends = (onnx_graph.STATE_IN, onnx_graph.STATE_OUT)
            widths |= dict.fromkeys(ends, self.state[0])
        return widths

    @property
    def most_rows(self) -> int:
        """Maximum number of observations per run."""
        return onnx_graph.MOST_ROWS if self.batch is None else self.batch

    @property
    def first_state(self) -> Rows | None:
        """State (S,) at the start of an episode; None without a state."""
        return None if self.state is None else np.full(*self.state, np.float32)


def check_policy_graph(data: bytes, needs: GraphNeeds, source: str) -> None:
    """Checks the graph of a policy file before any of it runs. Raises PolicyError."""
    model = onnx_graph.parsed(data, source)
    onnx_graph.check_graph(model, source)
    onnx_graph.check_ends(model, needs.widths, source, needs.batch)
    if onnx_graph.graph_hash(model) != needs.graph_sha256:
        reason = "does not match the graph, which was changed after the export."
        raise PolicyError(source, "graph_sha256", reason)
    onnx_graph.check_shapes(model, source, needs.most_rows)


def open_session(data: bytes, source: str) -> Any:
    """Opens a session on one thread. Raises ConfigError without onnxruntime, or PolicyError."""
    try:
        import onnxruntime
    except ImportError:
        fix = "pip install 'nics_drl_bridge[deploy]'."
        raise ConfigError(
            f"a policy file needs the module 'onnxruntime'; {fix}"
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(
            data, options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # noqa: BLE001 - the runtime's errors have no common base class
        raise cannot_run(source, error) from None


def cannot_run(source: str, error: Exception) -> PolicyError:
    """Returns the error for a graph that the runtime refuses."""
    reason = f"onnxruntime can't run it ({onnx_graph.quote(error)})."
    return PolicyError(source, "graph", reason)


def run_in_turn(
    run: Callable[..., Sequence[NDArray[Any]]], seen: Rows, needs: GraphNeeds
) -> list[NDArray[Any]]:
    """Computes actions and commands for observations (T, O), step by step if there is a state."""
    state = [] if needs.first_state is None else [needs.first_state[None]]
    size = 1 if state else needs.most_rows
    parts = []
    for first in range(0, len(seen), size):
        action, command, *state = run(seen[first : first + size], *state)
        parts.append((action, command))
    return [np.concatenate(rows) for rows in zip(*parts, strict=True)]


def run_rows(session: Any, source: str, *tensors: Rows) -> list[NDArray[Any]]:
    """Runs observations (n, O), and states (n, S) if there are any. Raises PolicyError."""
    names = (onnx_graph.INPUT, onnx_graph.STATE_IN)
    try:
        return list(session.run(None, dict(zip(names, tensors, strict=False))))
    except Exception as error:  # noqa: BLE001 - the runtime's errors have no common base class
        raise cannot_run(source, error) from None


def run_session(
    session: Any, needs: GraphNeeds, seen: Rows, source: str
) -> list[NDArray[Any]]:
    """Runs observations (T, O) like `run_in_turn`. Raises PolicyError."""
    return run_in_turn(partial(run_rows, session, source), seen, needs)
