"""Teaching beside the task: rewards by the truth, failed ones again, and easy ones first."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.env.task import Outcome
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.sim.guide import Guide
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator

FEWEST = 100  # episodes by which a level of a curriculum is judged, or as many as there are worlds
Share = Annotated[float, Field(gt=0.0, le=1.0)]


class Curriculum(Schema):
    """Starts near the goal at first, that move away as success rises (Florensa and others 2017).

    Each world of a training has its own level: the share of the way around obstacles, from where
    the world draws a start to the goal, that is left.
    """

    begin: Share = 0.2  # the first level
    step: Share = 0.1  # from one level to the next, up to 1: starts as they are drawn
    success: Share = (
        0.7  # least share of the episodes at a level after which the next one begins
    )


class Teaching(Schema):
    """Rewards by what only the simulator knows, repetition, easy starts; nothing by default."""

    contact: float | None = (
        None  # reward of a contact that the task misses, which ends the episode
    )
    path: float = (
        0.0  # reward of each metre by which the way around obstacles gets shorter
    )
    retries: int = Field(
        default=0, ge=0, le=1000
    )  # times that a failed episode is driven again
    # by which robots are larger all around while they learn [m], to keep away from what stands
    margin: float = Field(default=0.0, ge=0.0, le=1.0)
    curriculum: Curriculum | None = (
        None  # starts near the goal first; None: as worlds draw them
    )


class Teacher:
    """Teaches in the worlds of a simulator."""

    def __init__(self, given: Teaching, simulator: FastSimulator) -> None:
        self._given = given
        self._data = simulator.data
        self._guide: Guide | None = None
        self._left = np.zeros(
            simulator.data.pose.shape[:2]
        )  # (N, M) lengths of the ways [m]
        self._tries = np.zeros(
            len(self._left), np.int64
        )  # (N,) of the running episode again
        self._level = np.zeros(1, np.int64)
        self._begun = np.zeros(
            len(self._left), np.int64
        )  # (N,) level of the running episode
        self._results = np.zeros(2, np.int64)  # at this level: failures and successes
        if given.curriculum is not None and simulator.data.pose.shape[1] > 1:
            raise ConfigError(
                "teaching.curriculum: moves a single robot's start; leave it out."
            )
        if given.path or given.curriculum:
            footprint = footprint_shape(simulator.model.robot)
            self._guide = Guide(simulator.sampler, footprint, len(self._left))

    @property
    def changing(self) -> dict[str, NDArray[np.generic]]:
        """The arrays that change from step to step, by name."""
        known: dict[str, NDArray[np.generic]] = {"tries": self._tries}
        if self._guide is not None:
            known |= {"guide": self._guide.fields, "left": self._left}
        if self._given.curriculum is not None:
            known |= {
                "level": self._level,
                "begun": self._begun,
                "results": self._results,
            }
        return known

    @property
    def level(self) -> float:
        """Share of the way with which episodes begin."""
        given = self._given.curriculum
        if given is None:
            return 1.0
        return min(given.begin + given.step * int(self._level[0]), 1.0)

    def places(self, worlds: NDArray[np.intp], scenes: Scenes) -> Array:
        """Finds the ways of episodes that begin in some worlds (n,); returns starts (n, M, 3)."""
        self._begun[worlds] = self._level
        if self._guide is None:
            return scenes.starts
        self._guide.begin(worlds, scenes)
        level = self.level
        if level == 1.0:
            return scenes.starts
        return self._guide.nearer(worlds, scenes, level)

    def begin(self, worlds: NDArray[np.intp]) -> None:
        """Begins episodes in some worlds (n,), where the robots now are."""
        if self._guide is not None:
            self._left[worlds] = self._guide.lengths(worlds, self._data)

    def judge(self, part: slice, outcome: Outcome) -> Outcome:
        """An outcome of a part of the worlds, with these rewards besides."""
        terms = outcome.terms
        ended = outcome.ended
        info = outcome.info
        if self._guide is not None and self._given.path:
            left = self._guide.lengths(part, self._data)
            terms = terms | {"path": self._given.path * (self._left[part] - left)}
            self._left[part] = left
        if self._given.contact is not None:
            unseen = (self._data.collided[part] != 0) & ~ended
            terms = terms | {"contact": np.multiply(self._given.contact, unseen)}
            info = info | {"collision": unseen | info.get("collision", unseen)}
            ended = ended | unseen
        return Outcome(terms, ended, info)

    def again(
        self, over: NDArray[np.bool_], success: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Chooses the worlds (N,) that begin the episode which is over again.

        Raises the level, if there is a curriculum and enough episodes at this one succeeded.
        """
        self._judge_level(over, success)
        again: NDArray[np.bool_] = over & ~success & (self._tries < self._given.retries)
        self._tries[over] = np.where(again, self._tries + 1, 0)[over]
        return again

    def _judge_level(self, over: NDArray[np.bool_], success: NDArray[np.bool_]) -> None:
        given = self._given.curriculum
        if given is None or self.level == 1.0:
            return
        counted = over & (
            self._begun == self._level
        )  # not those that began at an easier one
        self._results += (counted & ~success).sum(), (counted & success).sum()
        count = int(self._results.sum())
        if count >= max(len(over), FEWEST):
            self._level += int(self._results[1] >= given.success * count)
            self._results[:] = 0
