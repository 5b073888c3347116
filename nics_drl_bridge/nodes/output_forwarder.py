"""Program that forwards a node's output, so that the node never waits for a reader.

`python output_forwarder.py LOG FROM:TO ...` copies lines between file descriptors, and all of them
to the file LOG, unless that is empty. If an output accepts nothing, such as a terminal after Ctrl-S
or a hanging disk, it keeps the newest lines, and drops and counts older ones. It ends when the node
has ended and all lines are written, or nobody has read the rest for a while.
"""

import os
import re
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

KEPT_LINES = 5_000  # most lines that wait for an output
LINE_BYTES = 8_192  # longer lines are cut
COLOURS = re.compile(rb"\x1b\[[0-9;]*m")
PATIENCE_S = 5.0  # time for writing the rest after the node's end [s]


class Output:
    """The newest lines that wait for one output, and the thread that writes them."""

    def __init__(self, open_output: Callable[[], int]) -> None:
        # called in the thread, because the disk may hang here too
        self._open_output = open_output
        self._lines: deque[tuple[int, bytes]] = deque(maxlen=KEPT_LINES)  # numbered
        self._count = 0
        self._ended = False
        self._lock = threading.Lock()
        self._changed = threading.Event()
        self.thread = threading.Thread(target=self._write_lines, daemon=True)
        self.thread.start()

    def put(self, line: bytes) -> None:
        """Add a line, which pushes out the oldest one if too many wait."""
        with self._lock:
            self._lines.append((self._count, line))
            self._count += 1
        self._changed.set()

    def end(self) -> None:
        """Mark the end: no line follows."""
        self._ended = True
        self._changed.set()

    def _write_lines(self) -> None:
        try:
            descriptor = self._open_output()
        except OSError:  # the folder of logs can't be written to
            descriptor = os.open(os.devnull, os.O_WRONLY)
        written = 0
        while self._lines or not self._ended:
            if not self._lines:
                self._changed.wait()
                self._changed.clear()
                continue
            number, line = self._lines.popleft()
            dropped = number - written
            written = number + 1
            if dropped:
                noun = "line was" if dropped == 1 else "lines were"
                why = "dropped here: nobody read this output"
                line = f"({dropped} {noun} {why})\n".encode() + line
            try:
                write_all(descriptor, line)
            except OSError:  # the reader has gone
                descriptor = os.open(os.devnull, os.O_WRONLY)


def write_all(descriptor: int, data: bytes) -> None:
    """Write data to a file descriptor, even if it is non-blocking. Raises OSError."""
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:  # somebody has made this output non-blocking
            select.select([], [descriptor], [])


def open_log(path: str) -> int:
    """Open a log file; its folder is made if missing."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)


def copy_lines(source: int, shown: Output, logs: Sequence[Output]) -> None:
    """Copy lines from a file descriptor until its end; only what is shown may have colours."""
    with open(source, "rb") as file:
        for line in iter(partial(file.readline, LINE_BYTES), b""):
            shown.put(line)
            for log in logs:
                log.put(COLOURS.sub(b"", line))


def main(log: str, pairs: Sequence[str]) -> None:
    """Copy between pairs of descriptors, given as `FROM:TO`, until all sources have ended."""
    logs = [Output(partial(open_log, log))] if log else []
    outputs = [*logs]
    readers = []
    for pair in pairs:
        source, descriptor = map(int, pair.split(":"))
        output = Output(partial(int, descriptor))
        reader = threading.Thread(target=copy_lines, args=(source, output, logs))
        reader.start()
        outputs.append(output)
        readers.append(reader)
    for reader in readers:
        reader.join()
    deadline = time.monotonic() + PATIENCE_S
    for output in outputs:
        output.end()
    for output in outputs:
        output.thread.join(max(0.0, deadline - time.monotonic()))
    os._exit(0)  # also while a thread waits for its output


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
