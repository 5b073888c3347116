"""The status line for long work; on a terminal, each text replaces the previous one."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

UPDATED_S = 0.5  # time between two texts that replace each other [s]
REPEATED_S = 20.0  # time between two texts on lines of their own [s]
CLEAR_LINE = "\r\x1b[K"


class StatusLine:
    """A line on standard error, or in a progress bar that shows it instead."""

    def __init__(self) -> None:
        self._bar: Callable[[str], None] | None = None  # owns the terminal's line
        self._is_shown = False  # True while the terminal's last line shows a text

    @property
    def in_place(self) -> bool:
        """True if each text replaces the previous one."""
        return self._bar is not None or sys.stderr.isatty()

    @property
    def interval_s(self) -> float:
        """Suitable time between two texts [s]."""
        return UPDATED_S if self.in_place else REPEATED_S

    def show(self, text: str) -> None:
        """Shows a text in place of the previous one, or on a new line if it can't be replaced."""
        if self._bar is not None:
            self._bar(text)
        elif sys.stderr.isatty():
            sys.stderr.write(f"{CLEAR_LINE}nics_drl_bridge: {text}")
            sys.stderr.flush()
            self._is_shown = True
        else:
            sys.stderr.write(f"nics_drl_bridge: {text}\n")

    def clear(self) -> None:
        """Removes the text from a terminal, so that the next output starts on an empty line."""
        if self._is_shown:
            sys.stderr.write(CLEAR_LINE)
            sys.stderr.flush()
            self._is_shown = False

    @contextmanager
    def shown_by(self, bar: Callable[[str], None]) -> Iterator[None]:
        """Lets a progress bar, which owns the terminal's line, show the texts of a block."""
        outer = self._bar
        self._bar = bar
        try:
            yield
        finally:
            self._bar = outer


STATUS = StatusLine()
