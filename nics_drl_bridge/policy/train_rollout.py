"""Transitions of a rollout for the lean engine, and their batches."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch


class Driven(NamedTuple):
    """A rollout as collected: T steps of N worlds."""

    seen: torch.Tensor  # (T + 1, N, O) normalised observations
    actions: torch.Tensor  # (T, N, C), or (T, N) discrete
    log_probs: torch.Tensor  # (T, N) of the actions when they were drawn
    rewards: torch.Tensor  # (T, N)
    done: torch.Tensor  # (T, N) 1 at ends of episodes
    cut: torch.Tensor  # (K,) indices t N + n of the truncated episodes
    final: torch.Tensor  # (K, O) last observations of these episodes


class Transitions(NamedTuple):
    """R = T N transitions: T steps of N worlds, step by step."""

    seen: torch.Tensor  # (R, O) normalised observations
    actions: torch.Tensor  # (R, C), or (R,) discrete
    log_probs: torch.Tensor  # (R,) of the actions when they were drawn
    advantages: torch.Tensor  # (R,)
    returns: torch.Tensor  # (R,) targets of the critic

    def batches(self, size: int, generator: torch.Generator) -> Iterator[Transitions]:
        """Yields batches of `size` transitions in random order; the last may be smaller."""
        for rows in torch.randperm(len(self.seen), generator=generator).split(size):
            yield Transitions(*(field[rows] for field in self))
