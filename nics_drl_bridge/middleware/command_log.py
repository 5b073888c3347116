"""The commands of the recent past, in the order in which they take effect."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Log = tuple[NDArray[np.int64], NDArray[np.float64], int]

ROOM = 128


class CommandLog:
    """Holds since when each command is in effect; before the first, the robot has none: zero.

    Args:
        width: of a command, C.
    """

    def __init__(self, width: int) -> None:
        self._effective = np.empty(ROOM, dtype=np.int64)
        self._commands = np.zeros((ROOM, width))
        self.clear()

    @property
    def arrays(self) -> Log:
        """Since when [ns] (K,), commands (K, C), and how many of the rows are in use."""
        return self._effective, self._commands, self._count

    def clear(self) -> None:
        """Forgets all commands."""
        self._effective[0] = np.iinfo(np.int64).min
        self._commands[0] = 0.0
        self._count = 1

    def keep(self, command: ArrayLike) -> None:
        """Forgets all commands but this one (C,), taken to have been in effect ever since."""
        self.clear()
        self._commands[0] = command

    def add(self, effective_ns: int, command: ArrayLike, needed_ns: int) -> bool:
        """Notes a command (C,).

        Args:
            effective_ns: since when it is in effect [ns].
            command: in the units and the order of the RobotSpec.
            needed_ns: what was in effect before this time [ns] may be forgotten.

        Returns:
            False when there is one of that very time already, which stays.
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
        """Drops what no longer counts, and doubles the room if that is not enough."""
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
        # Whatever came before the first one kept is taken to have been like it.
        self._effective[0] = np.iinfo(np.int64).min
