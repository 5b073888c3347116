"""Transitions of a rollout, from which the lean engine learns, and their batches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch


class Transitions(NamedTuple):
    """R transitions, T steps of N worlds, step after step; the last two for a learnt memory."""

    seen: torch.Tensor  # (R, O) normalised observations, with what a memory adds
    actions: torch.Tensor  # (R, C), or (R,) discrete
    log_probs: torch.Tensor  # (R,) of the actions when they were drawn
    advantages: torch.Tensor  # (R,)
    returns: torch.Tensor  # (R,) targets of the critic
    state: torch.Tensor | None = None  # (N, S) at the first step
    done: torch.Tensor | None = None  # (T, N) ends of episodes, which are 1

    def batches(self, size: int, generator: torch.Generator) -> Iterator[Transitions]:
        """Parts of about `size` transitions in random order; for a memory, all of some worlds."""
        if self.state is None or self.done is None:
            for rows in torch.randperm(len(self.seen), generator=generator).split(size):
                yield Transitions(*(each[rows] for each in self[:5]))
            return
        steps, worlds = self.done.shape
        firsts = worlds * torch.arange(steps)[:, None]
        for some in torch.randperm(worlds, generator=generator).split(max(1, size // steps)):
            rows = (firsts + some).flatten()
            part = Transitions(*(each[rows] for each in self[:5]))
            yield part._replace(state=self.state[some], done=self.done[:, some])
