"""Policy files: an `.onnx` with network, normaliser, commands and contract; never a pickle."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from nics_drl_bridge import extensions
from nics_drl_bridge.arguments import check_path
from nics_drl_bridge.env.registry import TASKS, make_task
from nics_drl_bridge.env.task import Task
from nics_drl_bridge.errors import ConfigError, PolicyError, suggest
from nics_drl_bridge.generator import SimulatorModel
from nics_drl_bridge.lidar.arrays import AnyArray
from nics_drl_bridge.lidar.sectors import make_sector_plan
from nics_drl_bridge.lidar.spec import LidarSpec
from nics_drl_bridge.policy.file import contract as contracts
from nics_drl_bridge.policy.file import onnx_graph, rehearsal
from nics_drl_bridge.policy.file.contract import MAPPINGS, Contract, Rows, leaves
from nics_drl_bridge.policy.file.onnx_session import open_session, run_in_turn, run_rows
from nics_drl_bridge.robot.spec import RobotSpec

GOLDEN_TOLERANCE = 1e-5
PERIOD_TOLERANCE = 1e-9
Run = Callable[..., list[AnyArray]]
"""Maps observations (n, O), and states (n, S) if any, to actions, commands and next states."""
ROBOT = {"command", "footprint", "footprint_radius"}
LIDAR = {"beams", "angle_min", "angle_max", "range_max", "mount"}


@dataclass(eq=False)
class PolicyFile:
    """A loaded and checked policy, with the path of its file and its contract."""

    path: Path
    contract: Contract
    _run_network: Run

    def act(self, observation: Rows) -> AnyArray:
        """Returns the action (C,) in [-1, 1], or () discrete, for (O,); or n actions for (n, O)."""
        return self.run(observation)[0]

    def command(self, observation: Rows) -> Rows:
        """Returns the command (C,) in SI, in the robot's order, for (O,); or (n, C) for (n, O)."""
        return self.run(observation)[1]

    def step(self, observation: Rows, state: Rows) -> tuple[AnyArray, Rows]:
        """Returns the action, and the state (S,) or (n, S) for the next observation."""
        action, _, following = self.run(observation, state)
        return action, following

    def run(self, observation: Rows, state: Rows | None = None) -> list[AnyArray]:
        """Returns action, command and next state (S,) or (n, S) for (O,) or (n, O).

        Raises PolicyError for a wrong shape or a missing state; see `make_policy`.
        """
        rows = np.asarray(observation, np.float32)
        kept = self.contract.state
        self._check_shapes(rows.shape, None if state is None else np.shape(state))
        tensors = [rows.reshape(-1, rows.shape[-1])]
        if kept is not None:
            tensors.append(np.asarray(state, np.float32).reshape(-1, kept.size))
        step = self.contract.batch or onnx_graph.MOST_ROWS
        firsts = range(0, max(len(tensors[0]), 1), step)
        out = [self._run(*(part[k : k + step] for part in tensors)) for k in firsts]
        whole = [np.concatenate(parts) for parts in zip(*out, strict=True)]
        return [part[0] if rows.ndim == 1 else part for part in whole]

    def _check_shapes(
        self, rows: tuple[int, ...], state: tuple[int, ...] | None
    ) -> None:
        """Raises PolicyError for another shape of observations or states, None without any."""
        size = self.contract.observation.size
        if len(rows) not in (1, 2) or rows[-1] != size:
            raise PolicyError(
                str(self.path),
                "observation.size",
                f"is {size}, but observations are {rows}; use the policy's own task.",
            )
        kept = self.contract.state
        wanted = None if kept is None else (*rows[:-1], kept.size)
        if state != wanted:
            reason = f"must have shape {wanted}, not {state}"
            raise PolicyError(
                str(self.path), "state", f"{reason}; `make_policy` keeps it."
            )

    def _run(self, rows: Rows, *state: Rows) -> list[AnyArray]:
        out = self._run_network(rows, *state)
        if any(len(part) != len(rows) for part in out):
            raise PolicyError(
                str(self.path),
                "graph",
                f"returns {[part.shape for part in out]} for {len(rows)} observations.",
            )
        return out

    @cached_property
    def task_options(self) -> dict[str, Any]:
        """Arguments of the policy's task: its options, scan and sensors."""
        options = dict(self.contract.task.options)
        if self.contract.scan is not None:
            options["scan"] = self.contract.scan
        if self.contract.sensors:
            options["sensors"] = self.contract.sensors
        return options

    def make_task(
        self, model: SimulatorModel, kind: str | type[Task] | None = None
    ) -> Task:
        """Makes the policy's task for a robot. Raises PolicyError if a field does not fit."""
        name = self.contract.task.name
        if kind is None and name not in TASKS:
            place = f"path/to/file.py:{name if name.isidentifier() else 'ClassName'}"
            raise PolicyError(
                str(self.path),
                "task.name",
                f"{name!r} is not a shipped task; give --task {place}, or task= in Python.",
            )
        self.check_fits(model)
        task = make_task(kind or name, model, self.task_options)
        self.check_fits(model, task)
        return task

    def check_fits(
        self, model: SimulatorModel | None, task: Task | None = None
    ) -> None:
        """Raises PolicyError, naming the field, unless the policy fits a robot and a task."""
        if model is not None:
            self._check_robot(model.robot, model.lidar)
            sensors = {
                sensor.name: sensor.model_dump(mode="json") for sensor in model.sensors
            }
            self._compare(
                {
                    "sensors": [
                        sensors.get(sensor.name) for sensor in self.contract.sensors
                    ]
                }
            )
            period = model.control_period
            if abs(self.contract.control_period - period) > PERIOD_TOLERANCE:
                self._compare({"control_period": period})
        if task is not None:
            self._check_robot(task.robot, task.lidar)
            self._compare(
                {
                    "task": {"name": contracts.describe_task(task)["name"]},
                    "actions": task.actions,
                    "scan": None
                    if task.scan is None
                    else task.scan.model_dump(mode="json"),
                    "observation": contracts.describe_observation(task),
                }
            )

    def _check_robot(self, robot: RobotSpec, lidar: LidarSpec) -> None:
        theirs = {"robot": robot.model_dump(mode="json", include=ROBOT)}
        if self.contract.scan is None:
            theirs["lidar"] = lidar.model_dump(mode="json", include=LIDAR)
        else:
            try:
                make_sector_plan(lidar, self.contract.scan)
            except ConfigError as error:
                reason = f"does not suit this lidar: {error.reason}"
                raise PolicyError(
                    str(self.path),
                    "scan",
                    f"{reason}; use another lidar, or a policy trained for this one.",
                ) from None
        self._compare(theirs)

    def _compare(self, theirs: Mapping[str, Any]) -> None:
        """Raises PolicyError for the first entry that differs from the contract."""
        for name, entry in theirs.items():
            only: Any = {name: set(entry) if isinstance(entry, dict) else True}
            ours = dict(leaves(self.contract.model_dump(mode="json", include=only)))
            robots = dict(leaves({name: entry}))
            for path in (*ours, *robots):
                if ours.get(path) != robots.get(path):
                    reason = f"is {ours.get(path)!r}, but the robot's is {robots.get(path)!r}"
                    reason += "; use a policy trained for that."
                    raise PolicyError(str(self.path), path, reason)


def load_policy(path: str | Path, model: SimulatorModel | None = None) -> PolicyFile:
    """Loads and checks a policy file, by path or shipped name, or a foreign policy's YAML file.

    `model` is the robot of a foreign policy; None: the one that its YAML file names. Raises
    PolicyError, and ConfigError for a wrong YAML file.
    """
    check_path("policy", path)
    file = Path(path)
    if str(path).endswith(MAPPINGS):
        return policy_of(foreign_policies().import_policy(file, model), file)
    suffix = contracts.SUFFIX
    if not (str(path).endswith(suffix) or file.is_file()):
        file = contracts.shipped() / f"{path}{suffix}"
        if not file.is_file():
            hint = suggest(
                str(path), (shipped.stem for shipped in file.parent.glob(f"*{suffix}"))
            )
            raise PolicyError(
                str(path), "file", f"is neither a file nor a shipped policy; {hint}"
            )
    return policy_of(onnx_graph.read_network(file, str(file), "file"), file)


def foreign_policies() -> Any:
    """Returns the module that runs, imports and exports policies of other programs."""
    return extensions.load("adapters", "foreign")


def policy_of(data: bytes, path: Path) -> PolicyFile:
    """Makes a policy from a file's content; see `load_policy`."""
    source = str(path)
    onnx_graph.check_seal(data, source)
    # Shipped policies are trusted like the package's code.
    if path.parent != contracts.shipped():
        rehearsal.rehearse(data, source)
    model = onnx_graph.parse(data, source)
    contract = contracts.read_contract(
        onnx_graph.find_contract_text(model, source), source
    )
    if onnx_graph.hash_graph(model) != contract.graph_sha256:
        raise PolicyError(
            source,
            "graph_sha256",
            "does not match the graph, which was changed after the export.",
        )
    session = open_session(data, source)
    if contract.foreign is None:
        _check_ends(contract, session, source)
        run = partial(run_rows, session, source)
    else:
        run = foreign_policies().adapt(contract, session, source)
    policy = PolicyFile(path, contract, run)
    _check_golden(policy, source)
    return policy


def _check_ends(contract: Contract, session: Any, source: str) -> None:
    """Raises PolicyError for other inputs or outputs; the golden pairs show their widths."""
    kind = "tensor(float)"
    action = "tensor(int64)" if contract.actions == "discrete" else kind
    inputs = [(onnx_graph.INPUT, kind)]
    outputs = [(onnx_graph.ACTION, action), (onnx_graph.COMMAND, kind)]
    if contract.state is not None:
        inputs.append((onnx_graph.STATE_IN, kind))
        outputs.append((onnx_graph.STATE_OUT, kind))
    for name, ends, wanted in (
        ("inputs", session.get_inputs(), inputs),
        ("outputs", session.get_outputs(), outputs),
    ):
        found = [(end.name, end.type) for end in ends]
        if found != wanted:
            raise PolicyError(
                source,
                f"graph.{name}",
                f"are {found}, not {wanted}; export the policy again.",
            )


def _check_golden(policy: PolicyFile, source: str) -> None:
    golden = policy.contract.golden
    state = policy.contract.state
    robot = policy.contract.robot
    discrete = policy.contract.actions == "discrete"
    for name, width in (
        ("actions", 1 if discrete else len(robot.command)),
        ("commands", len(robot.command)),
    ):
        columns = golden.rows(name).shape[1]
        if columns != width:
            raise PolicyError(
                source,
                f"golden.{name}",
                f"have {columns} columns, but {width} are needed.",
            )
    start = None if state is None else np.full(state.size, state.start, np.float32)
    action, command = run_in_turn(policy.run, golden.rows("observations"), start)
    for name, rows in (
        ("actions", action.reshape(len(command), -1)),
        ("commands", command),
    ):
        reason = _explain_gap(golden.rows(name), rows)
        if reason:
            raise PolicyError(source, f"golden.{name}", reason)
    if (
        (command < robot.command_low - GOLDEN_TOLERANCE)
        | (command > robot.command_high + GOLDEN_TOLERANCE)
    ).any():
        raise PolicyError(
            source, "robot.command", "the graph returns commands beyond these limits."
        )


def _explain_gap(golden: Rows, rows: AnyArray) -> str:
    """Returns how golden rows differ from the outputs of the graph; "" if they agree."""
    if rows.shape != golden.shape:
        return f"have shape {golden.shape}, but the graph's outputs {rows.shape}."
    gap = np.abs(rows - golden).max()
    if gap <= GOLDEN_TOLERANCE:
        return ""
    return f"differ by {gap:.3g} from the graph's outputs on this machine; not used."


def summary(policy: PolicyFile) -> dict[str, Any]:
    """Returns the contract as plain data, without arrays and checksums."""
    data = policy.contract.model_dump(mode="json", exclude={"golden", "checksums"})
    return {"file": str(policy.path), "bytes": policy.path.stat().st_size, **data}
