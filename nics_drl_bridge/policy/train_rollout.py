"""Transitions of a rollout, from which the lean engine learns, and their batches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch


class Driven(NamedTuple):
    """A rollout as it was driven: T steps of N worlds."""

    seen: torch.Tensor  # (T + 1, N, O) normalised observations, with what a memory adds
    actions: torch.Tensor  # (T, N, C), or (T, N) discrete
    log_probs: torch.Tensor  # (T, N) of the actions when they were drawn
    rewards: torch.Tensor  # (T, N)
    done: torch.Tensor  # (T, N) ends of episodes, which are 1
    cut: torch.Tensor  # (K,) t N + n of those that a time limit ended
    final: torch.Tensor  # (K, O) what was seen there at last
    state: torch.Tensor  # (N, S) of the memory at the first step


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
        for some in torch.randperm(worlds, generator=generator).split(
            max(1, size // steps)
        ):
            rows = (firsts + some).flatten()
            part = Transitions(*(each[rows] for each in self[:5]))
            yield part._replace(state=self.state[some], done=self.done[:, some])
