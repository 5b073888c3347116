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

KEPT_BYTES = 2**20  # most bytes of lines that wait for an output
CHUNK_BYTES = 65_536
COLOURS = re.compile(rb"\x1b\[[0-9;]*m")
PATIENCE_S = 5.0  # time for writing the rest after the node's end [s]


class Output:
    """The lines that wait for one output, and the thread that writes them."""

    def __init__(self, open_output: Callable[[], int]) -> None:
        self._open_output = (
            open_output  # called in the thread, because the disk may hang here too
        )
        self._descriptor = -1
        self._lines: deque[bytes] = deque()
        self._bytes = 0  # of these lines
        self._dropped = 0  # lines since the last one written
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._write_lines, daemon=True)
        self._thread.start()

    def put(self, line: bytes) -> None:
        """Add a line, and drop the oldest ones if too much waits."""
        with self._changed:
            self._lines.append(line)
            self._bytes += len(line)
            while self._bytes > KEPT_BYTES and len(self._lines) > 1:
                self._bytes -= len(self._lines.popleft())
                self._dropped += 1
            self._changed.notify()

    def end(self) -> None:
        """Mark the end: no line follows."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def join(self, seconds: float) -> None:
        """Wait until all lines are written, or for some time."""
        self._thread.join(seconds)

    def _write_lines(self) -> None:
        try:
            self._descriptor = self._open_output()
        except OSError:  # the folder of logs can't be written to
            self._descriptor = os.open(os.devnull, os.O_WRONLY)
        while True:
            with self._changed:
                while not self._lines and not self._ended:
                    self._changed.wait()
                if not self._lines:
                    return
                line = self._lines.popleft()
                self._bytes -= len(line)
                dropped = self._dropped
                self._dropped = 0
            try:
                if dropped:
                    self._write(told_of(dropped))
                self._write(line)
            except OSError:  # the reader has gone
                self._descriptor = os.open(os.devnull, os.O_WRONLY)

    def _write(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self._descriptor, data) :]
            except BlockingIOError:  # somebody has made this output non-blocking
                select.select([], [self._descriptor], [])


def told_of(dropped: int) -> bytes:
    """Return the line that says how many lines were dropped."""
    lines = "line was" if dropped == 1 else "lines were"
    return f"({dropped} {lines} dropped here: nobody read this output)\n".encode()


def open_log(path: str) -> int:
    """Open a log file; its folder is made if missing."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)


def copy_lines(source: int, outputs: Sequence[Output]) -> None:
    """Copy lines from a file descriptor to outputs until its end."""
    rest = b""
    for chunk in iter(partial(os.read, source, CHUNK_BYTES), b""):
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            put_line(line + b"\n", outputs)
        if len(rest) > CHUNK_BYTES:
            put_line(rest, outputs)
            rest = b""
    if rest:
        put_line(rest, outputs)


def put_line(line: bytes, outputs: Sequence[Output]) -> None:
    """Add a line to outputs; only the first may show colours."""
    shown, *others = outputs
    shown.put(line)
    for output in others:
        output.put(COLOURS.sub(b"", line))


def main(log: str, pairs: Sequence[str]) -> None:
    """Copy between pairs of descriptors, given as `FROM:TO`, until all sources have ended."""
    logs = [Output(partial(open_log, log))] if log else []
    outputs = [*logs]
    readers = []
    for pair in pairs:
        source, descriptor = map(int, pair.split(":"))
        output = Output(partial(int, descriptor))
        reader = threading.Thread(target=copy_lines, args=(source, [output, *logs]))
        reader.start()
        outputs.append(output)
        readers.append(reader)
    for reader in readers:
        reader.join()
    deadline = time.monotonic() + PATIENCE_S
    for output in outputs:
        output.end()
    for output in outputs:
        output.join(max(0.0, deadline - time.monotonic()))
    os._exit(0)  # also while a thread waits for its output


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
