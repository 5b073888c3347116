"""What the `info` of a vector env is made of: facts of its worlds, by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nics_drl_bridge.env.task import Outcome
from nics_drl_bridge.sim.simulator import FastSimulator

Array = NDArray[np.float64]
Rows = slice | NDArray[np.intp]
EVERY = slice(None)


class VectorFacts:
    """Gives facts as arrays (N, ...) of worlds of one robot, or (N, M, ...) of teams.

    Args:
        simulator: of the worlds.
        period_ns: control period [ns].
    """

    def __init__(self, simulator: FastSimulator, period_ns: int) -> None:
        self._simulator, self._period_ns = simulator, period_ns
        self._alone = simulator.data.pose.shape[1] == 1

    def known(self, shown: Mapping[str, NDArray[Any]], rows: Rows = EVERY) -> dict[str, Any]:
        """What is known at any time, of some worlds, in arrays of its own.

        Args:
            shown: what the task shows of its memory (N, M, ...).
            rows: which worlds.
        """
        pose = self._own(self._simulator.data.odom[rows])
        told = {name: self._own(values[rows]) for name, values in shown.items()}
        ages = np.zeros(len(pose))
        return {**told, "pose": pose, "scan_age_s": ages, "odom_age_s": ages.copy()}

    def beginnings(self, starts: Array, bodies: Array, rows: Rows) -> dict[str, Any]:
        """What is told of episodes that begin, with what the randomisation drew for them.

        Args:
            starts: (N, M, 3) poses of the robots.
            bodies: (N, K, 7) the obstacles.
            rows: which worlds.
        """
        drawn = {
            name: self._row(values[rows]) if values.ndim > 1 else values[rows]
            for name, values in self._simulator.drawn.items()
        }
        return {
            "episode_seed": self._simulator.data.seeds[rows],
            "start": self._row(starts[rows]),
            "bodies": bodies[rows],
            **({"randomisation": drawn} if drawn else {}),
        }

    def of_step(self, outcome: Outcome) -> dict[str, Any]:
        """What is told of a step, of every world, in arrays of its own."""
        data = self._simulator.data
        return {
            "stamp_ns": data.steps * self._period_ns,
            "true_pose": self._own(data.pose),
            "true_collision": self._row(data.collided).astype(np.bool_),
            **{name: self._own(values) for name, values in outcome.info.items()},
            "reward_terms": {name: self._own(term) for name, term in outcome.terms.items()},
        }

    def _own(self, rows: NDArray[Any]) -> NDArray[Any]:
        return self._row(rows).copy()

    def _row(self, rows: NDArray[Any]) -> NDArray[Any]:
        return rows[:, 0] if self._alone else rows
