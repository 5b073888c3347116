"""The commands of the recent past, in the order in which they take effect."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Log = tuple[NDArray[np.int64], NDArray[np.float64], int]

ROOM = 128


class CommandLog:
    """Commands with the times at which they take effect; before the first, the command is zero.

    Args:
        width: of a command, C.
    """

    def __init__(self, width: int) -> None:
        self._effective = np.empty(ROOM, dtype=np.int64)
        self._commands = np.zeros((ROOM, width))
        self.clear()

    @property
    def arrays(self) -> Log:
        """Times at which they take effect [ns] (K,), commands (K, C), and number of used rows."""
        return self._effective, self._commands, self._count

    def clear(self) -> None:
        """Forgets all commands."""
        self._effective[0] = np.iinfo(np.int64).min
        self._commands[0] = 0.0
        self._count = 1

    def keep(self, command: ArrayLike) -> None:
        """Forgets all commands but this one (C,), which counts as always in effect."""
        self.clear()
        self._commands[0] = command

    def add(self, effective_ns: int, command: ArrayLike, needed_ns: int) -> bool:
        """Adds a command (C,).

        Args:
            effective_ns: time at which it takes effect [ns].
            command: in the units and the order of the RobotSpec.
            needed_ns: commands superseded before this time [ns] may be forgotten.

        Returns:
            False if there already is one of exactly that time, which is kept.
        """
        if self._count == len(self._effective):
            self._make_room(needed_ns)
        end = self._count
        place = end
        while self._effective[place - 1] >= effective_ns:
            place -= 1
        if place < end and self._effective[place] == effective_ns:
            return False
        if place < end:
            self._effective[place + 1 : end + 1] = self._effective[place:end].copy()
            self._commands[place + 1 : end + 1] = self._commands[place:end].copy()
        self._effective[place], self._commands[place] = effective_ns, command
        self._count += 1
        return True

    def _make_room(self, needed_ns: int) -> None:
        """Drops commands that are no longer needed; doubles the capacity if that is not enough."""
        used = self._effective[: self._count]
        first = max(int(np.searchsorted(used, needed_ns, side="right")) - 1, 0)
        kept = slice(first, self._count)
        effective, commands = self._effective[kept].copy(), self._commands[kept].copy()
        size = len(self._effective)
        if len(effective) > size // 2:
            self._effective = np.empty(2 * size, dtype=np.int64)
            self._commands = np.zeros((2 * size, commands.shape[1]))
        self._count = len(effective)
        self._effective[: self._count], self._commands[: self._count] = effective, commands
        # The first command kept counts as in effect at all earlier times.
        self._effective[0] = np.iinfo(np.int64).min
