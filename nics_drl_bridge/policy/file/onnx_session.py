"""Opens a policy's graph in onnxruntime and checks it; imports little, see `rehearsal`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from nics_drl_bridge.errors import ConfigError, PolicyError
from nics_drl_bridge.policy.file import onnx_graph

Rows = NDArray[np.float32]


def check_network(data: bytes, source: str, runs: bool) -> None:
    """Checks the form of a network, and if it `runs`, also its sizes by a run on zeros.

    An open first dimension of its inputs is the number of observations; the run uses
    the largest number that is ever run at once. The cost cannot be predicted; see
    `rehearsal`. Raises PolicyError.
    """
    model = onnx_graph.parse(data, source)
    onnx_graph.check_graph(model, source)
    if not runs:
        return
    fixed = onnx_graph.fix_rows(model, onnx_graph.MOST_ROWS)
    checked = fixed
    # If the number of rows is open, nothing that depends on it may be folded, because
    # the check would hold only for this number. Otherwise onnxruntime precomputes
    # everything that does not depend on values.
    if not onnx_graph.has_open_rows(model):
        with TemporaryDirectory() as folder:
            file = Path(folder) / "folded.onnx"
            open_session(fixed.SerializeToString(), source, file)
            checked = onnx.load(file)
    onnx_graph.check_sizes(checked, source)
    feeds = {}
    for value in onnx_graph.list_inputs(fixed):
        tensor = value.type.tensor_type
        shape = [dimension.dim_value for dimension in tensor.shape.dim]
        dtype = onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type)
        feeds[value.name] = np.zeros(shape, dtype)
    run_network(open_session(data, source), source, feeds)


def open_session(data: bytes, source: str, folded: Path | None = None) -> Any:
    """Opens a session on one thread. Raises ConfigError without onnxruntime, or PolicyError.

    `folded` is a file to which the graph is written after constant folding.
    """
    try:
        import onnxruntime
    except ImportError:
        raise ConfigError(
            "a policy file needs the module 'onnxruntime'; pip install 'nics_drl_bridge[deploy]'."
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = 4
    if folded is not None:
        levels = onnxruntime.GraphOptimizationLevel
        options.graph_optimization_level = levels.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(folded)
    try:
        return onnxruntime.InferenceSession(
            data, options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # noqa: BLE001 - the runtime's errors have no common base class
        raise _explain_failure(source, error) from None


def run_network(
    session: Any, source: str, feeds: dict[str, NDArray[Any]]
) -> list[NDArray[Any]]:
    """Runs a network on its inputs by name; returns its outputs. Raises PolicyError."""
    try:
        return list(session.run(None, feeds))
    except Exception as error:  # noqa: BLE001 - the runtime's errors have no common base class
        raise _explain_failure(source, error) from None


def _explain_failure(source: str, error: Exception) -> PolicyError:
    return PolicyError(
        source, "graph", f"onnxruntime can't run it ({onnx_graph.quote(error)})."
    )


def run_rows(session: Any, source: str, *tensors: Rows) -> list[NDArray[Any]]:
    """Runs observations (n, O), and states (n, S) if there are any. Raises PolicyError."""
    names = (onnx_graph.INPUT, onnx_graph.STATE_IN)
    return run_network(session, source, dict(zip(names, tensors, strict=False)))


def run_in_turn(
    run: Callable[..., Sequence[NDArray[Any]]], seen: Rows, state: Rows | None
) -> list[NDArray[Any]]:
    """Computes actions and commands for observations (T, O), one by one from a state (S,)."""
    if state is None:
        return list(run(seen)[:2])
    states = [state[None]]
    steps = []
    for row in seen:
        action, command, *states = run(row[None], *states)
        steps.append((action, command))
    return [np.concatenate(rows) for rows in zip(*steps, strict=True)]
