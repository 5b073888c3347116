"""Training aids: rewards from the ground truth, and repetition of failed episodes."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from nics_drl_bridge.config import Schema
from nics_drl_bridge.env.guide import Guide
from nics_drl_bridge.env.task import Outcome
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.lidar.arrays import Mask
from nics_drl_bridge.sim.scenes import Scenes
from nics_drl_bridge.sim.simulator import FastSimulator


class Teaching(Schema):
    """Rewards from the ground truth, and repetition of failed episodes; off by default."""

    # reward for a contact that the task does not detect; it also ends the episode
    contact: float | None = None
    # reward per metre by which the path to the goal around obstacles shortens
    path: float = 0.0
    # maximum number of repetitions of a failed episode
    retries: int = Field(default=0, ge=0, le=1000)
    # margin added to robots during training, so that they learn to keep a distance [m]
    margin: float = Field(default=0.0, ge=0.0, le=1.0)


class Teacher:
    """Applies teaching in the worlds of a simulator."""

    def __init__(self, given: Teaching, simulator: FastSimulator) -> None:
        self._given = given
        self._data = simulator.data
        self._guide: Guide | None = None
        # (N, M) remaining path lengths [m]
        self._left = np.zeros(simulator.data.pose.shape[:2])
        # (N,) repetitions of the current episode so far
        self._tries = np.zeros(len(self._left), np.int64)
        if given.path:
            footprint = footprint_shape(simulator.model.robot)
            self._guide = Guide(simulator.sampler, footprint, len(self._left))

    @property
    def changing(self) -> dict[str, NDArray[np.generic]]:
        """Arrays that change from step to step, by name."""
        known: dict[str, NDArray[np.generic]] = {"tries": self._tries}
        if self._guide is not None:
            known |= {"guide": self._guide.fields, "left": self._left}
        return known

    def begin(self, worlds: NDArray[np.intp], scenes: Scenes) -> None:
        """Starts episodes in worlds (n,), given their scenes."""
        if self._guide is not None:
            self._guide.begin(worlds, scenes)
            self._left[worlds] = self._guide.measure_lengths(worlds, self._data)

    def judge(self, part: slice, outcome: Outcome) -> Outcome:
        """Adds teaching rewards to the outcome of a part of the worlds."""
        terms = outcome.terms
        ended = outcome.ended
        info = outcome.info
        if self._guide is not None:
            left = self._guide.measure_lengths(part, self._data)
            nearer = self._left[part] - left
            terms = terms | {"path": self._given.path * nearer}
            self._left[part] = left
        if self._given.contact is not None:
            unseen = (self._data.collided[part] != 0) & ~ended
            reward = np.multiply(self._given.contact, unseen)
            terms = terms | {"contact": reward}
            collision = unseen | info.get("collision", unseen)
            info = info | {"collision": collision}
            ended = ended | unseen
        return Outcome(terms, ended, info)

    def find_repeats(self, over: Mask, success: Mask) -> Mask:
        """Returns True for worlds (N,) that repeat the episode that just ended."""
        again: Mask = over & ~success & (self._tries < self._given.retries)
        self._tries[over] = np.where(again, self._tries + 1, 0)[over]
        return again
