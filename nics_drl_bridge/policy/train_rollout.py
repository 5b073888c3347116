"""Transitions of a rollout, from which the lean engine learns, and their batches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch


class Driven(NamedTuple):
    """A rollout as it was driven: T steps of N worlds."""

    seen: torch.Tensor  # (T + 1, N, O) normalised observations
    actions: torch.Tensor  # (T, N, C), or (T, N) discrete
    log_probs: torch.Tensor  # (T, N) of the actions when they were drawn
    rewards: torch.Tensor  # (T, N)
    done: torch.Tensor  # (T, N) ends of episodes, which are 1
    cut: torch.Tensor  # (K,) t N + n of those that a time limit ended
    final: torch.Tensor  # (K, O) what was seen there at last


class Transitions(NamedTuple):
    """R transitions, T steps of N worlds, step after step."""

    seen: torch.Tensor  # (R, O) normalised observations
    actions: torch.Tensor  # (R, C), or (R,) discrete
    log_probs: torch.Tensor  # (R,) of the actions when they were drawn
    advantages: torch.Tensor  # (R,)
    returns: torch.Tensor  # (R,) targets of the critic

    def batches(self, size: int, generator: torch.Generator) -> Iterator[Transitions]:
        """Parts of `size` transitions in random order; the last may have fewer."""
        for rows in torch.randperm(len(self.seen), generator=generator).split(size):
            yield Transitions(*(each[rows] for each in self))
