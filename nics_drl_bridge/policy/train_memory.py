"""Memories of an actor: a stack of past scans, and a gated recurrent unit; each keeps a state."""

from typing import ClassVar

import torch

from nics_drl_bridge.policy.training_settings import GruMemory, StackMemory

Pair = tuple[torch.Tensor, torch.Tensor]
UNSET = -10.0  # of a scan before the first one: normalised observations are cut at +-5


class Memory(torch.nn.Module):  # type: ignore[misc]
    """Adds what a state remembers to normalised observations; this one remembers nothing."""

    learnt: ClassVar[bool] = False  # True if it has weights
    size: int = 0  # S, of the state
    start: float = 0.0  # each element of the state when an episode begins
    extra: int = 0  # E, number of features that it adds

    def forward(self, seen: torch.Tensor, state: torch.Tensor) -> Pair:
        """Features (n, O + E) and the next state (n, S), for observations (n, O)."""
        return seen, state

    def begin(self, count: int) -> torch.Tensor:
        """The state (n, S) with which episodes begin."""
        return torch.full((count, self.size), self.start)

    def begun(self, state: torch.Tensor, done: torch.Tensor) -> torch.Tensor:
        """The state (n, S), anew where an episode is `done` (n,)."""
        return torch.where(done[:, None] > 0, self.begin(1), state)

    def unroll(
        self, seen: torch.Tensor, state: torch.Tensor, done: torch.Tensor
    ) -> torch.Tensor:
        """Features (T, n, O + E) of steps (T, n, O) with ends of episodes (T, n), from a state."""
        features = []
        for given, over in zip(seen, done, strict=True):
            added, state = self(given, state)
            features.append(added)
            state = self.begun(state, over)
        return torch.stack(features)


class Stack(Memory):
    """Adds earlier scans, a number of steps apart; those before the first are like the first."""

    start = UNSET

    def __init__(self, settings: StackMemory, scan_parts: int) -> None:
        super().__init__()
        self._parts = scan_parts
        self._every = settings.every
        self._kept = (settings.scans - 1) * settings.every
        self.size = self._kept * scan_parts
        self.extra = (settings.scans - 1) * scan_parts

    def forward(self, seen: torch.Tensor, state: torch.Tensor) -> Pair:
        """See `Memory`; the state holds the oldest scan first."""
        scan = seen[:, : self._parts]
        unset = torch.clamp(0.5 * UNSET - state, 0.0, 1.0)
        past = (1.0 - unset) * state + unset * torch.cat([scan] * self._kept, 1)
        first = range(0, self.size, self._parts * self._every)
        added = [past[:, k : k + self._parts] for k in first]
        return torch.cat([seen, *added], 1), torch.cat(
            [past[:, self._parts :], scan], 1
        )


class Gru(Memory):
    """Adds the state of a gated recurrent unit (Cho and others 2014), as in `torch.nn.GRUCell`."""

    learnt = True
    start = 0.0

    def __init__(self, settings: GruMemory, inputs: int) -> None:
        super().__init__()
        self.size = self.extra = settings.units
        self.seen = torch.nn.Linear(inputs, 3 * self.size)
        self.kept = torch.nn.Linear(self.size, 3 * self.size)
        for layer in (self.seen, self.kept):
            for gate in layer.weight.data.split(self.size):
                torch.nn.init.orthogonal_(gate)
            torch.nn.init.zeros_(layer.bias)

    def forward(self, seen: torch.Tensor, state: torch.Tensor) -> Pair:
        """See `Memory`."""
        reset, update, new = self.seen(seen).split([self.size] * 3, 1)
        kept_reset, kept_update, kept_new = self.kept(state).split([self.size] * 3, 1)
        update = torch.sigmoid(update + kept_update)
        new = torch.tanh(new + torch.sigmoid(reset + kept_reset) * kept_new)
        following = new + update * (state - new)
        return torch.cat([seen, following], 1), following


def memory_of(
    settings: StackMemory | GruMemory | None, inputs: int, scan_parts: int
) -> Memory:
    """Makes the memory of settings, for observations (n, inputs) that begin with a scan."""
    if settings is None:
        return Memory()
    if isinstance(settings, GruMemory):
        return Gru(settings, inputs)
    return Stack(settings, scan_parts)
