"""Opens a policy's graph in onnxruntime after all checks; imports little, see `rehearsal`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.policy import onnx_graph

Rows = NDArray[np.float32]


@dataclass(frozen=True)
class GraphNeeds:
    """What a policy file states about its graph, as plain data."""

    # widths of inputs and outputs; None: integers, one per row
    widths: dict[str, int | None]
    batch: int | None  # maximum number of observations per run; None: no maximum
    graph_sha256: str
    # start value of each element of the state; None: the policy has no state
    start: float | None = None


def check_policy_graph(data: bytes, needs: GraphNeeds, source: str) -> int:
    """Checks the graph of a policy file before any of it runs. Raises PolicyError.

    Returns the number of observations per run.
    """
    model = onnx_graph.parse(data, source)
    onnx_graph.check_ends(model, needs.widths, source, needs.batch)
    if onnx_graph.graph_hash(model) != needs.graph_sha256:
        reason = "does not match the graph, which was changed after the export."
        raise PolicyError(source, "graph_sha256", reason)
    return onnx_graph.rows_at_once(model, source, needs.batch)


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


def cannot_run(source: str, error: Exception, field: str = "graph") -> PolicyError:
    """Returns the error for a graph that the runtime refuses."""
    reason = f"onnxruntime can't run it ({onnx_graph.quote(error)})."
    return PolicyError(source, field, reason)


def in_turn(
    run: Callable[..., Sequence[NDArray[Any]]], seen: Rows, start: Rows | None
) -> list[NDArray[Any]]:
    """Computes actions and commands for observations (T, O), step by step if given a state (S,)."""
    if start is None:
        return list(run(seen))
    state = start[None]
    rows = []
    for k in range(len(seen)):
        *out, state = run(seen[k : k + 1], state)
        rows.append(out)
    return [np.concatenate(parts) for parts in zip(*rows, strict=True)]


def run_once(session: Any, needs: GraphNeeds, seen: Rows, source: str) -> None:
    """Runs observations (T, O), as one episode if there is a state. Raises PolicyError."""
    start = None
    if needs.start is not None:
        start = np.full(needs.widths[onnx_graph.STATE_IN] or 1, needs.start, np.float32)

    def run(*tensors: Rows) -> list[NDArray[Any]]:
        names = (onnx_graph.INPUT, onnx_graph.STATE_IN)
        try:
            return list(session.run(None, dict(zip(names, tensors, strict=False))))
        except Exception as error:  # noqa: BLE001 - the runtime's errors have no common base class
            raise cannot_run(source, error) from None

    rows_at_once = 1 if needs.batch == 1 else len(seen)
    for first in range(0, len(seen), rows_at_once):
        in_turn(run, seen[first : first + rows_at_once], start)
