"""Program that keeps the gate's recent inputs and writes them to a file at each stop.

The gate starts this program when it starts itself, and feeds it through a pipe. So a stop costs the
gate nothing, a hanging disk blocks only this process, and a file is completed even if the gate is
killed.

Messages on standard input are lines: `STATE` and `ENTRY` are followed by a line of the black box,
`WRITE` by JSON with the path and the names of the gate's files. An answer on standard output is
JSON with the path and the failure, which is empty if there was none.
"""

import contextlib
import json
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from nics_drl_bridge.files import write_parts
from nics_drl_bridge.gate.seal import append_checksum

STATE = b"S"
ENTRY = b"E"
WRITE = b"W"
KEPT_S = 30.0  # minimum time span of the lines that are kept [s]
MOST_LINES = 18_000  # fewer than a replay takes
MOST_BYTES = 48 * 2**20
FILES_KEPT = 20
NICENESS = 5
CHUNK_BYTES = 2**20
GIVEN_UP = threading.Event()  # set by SIGTERM


@dataclass
class Segment:
    """A state of the gate, and the entries that follow it."""

    begin_s: float  # time of the state
    lines: list[bytes] = field(default_factory=list)
    size: int = 0  # of the lines [bytes]

    def add(self, line: bytes) -> None:
        """Add a line."""
        self.lines.append(line)
        self.size += len(line)


class Ring:
    """The latest lines of the black box, beginning with a state of the gate."""

    def __init__(self, kept_s: float = KEPT_S, most_lines: int = MOST_LINES) -> None:
        self._kept_s = kept_s
        self._most_lines = most_lines
        self._segments: deque[Segment] = deque()

    def begin(self, now: float, state: bytes) -> None:
        """Begin a segment with a state at a time [s], and drop segments that are too old."""
        self._segments.append(Segment(now))
        self._segments[-1].add(state)
        while (
            len(self._segments) > 1 and self._segments[1].begin_s <= now - self._kept_s
        ):
            self._segments.popleft()

    def add(self, entry: bytes) -> None:
        """Add an entry to the newest segment, and drop old ones if there is too much."""
        self._segments[-1].add(entry)
        while len(self._segments) > 1 and self._is_full():
            self._segments.popleft()

    def _is_full(self) -> bool:
        lines = sum(len(segment.lines) for segment in self._segments)
        size = sum(segment.size for segment in self._segments)
        return lines > self._most_lines or size > MOST_BYTES

    def lines(self) -> list[bytes]:
        """Return the lines for a file: the oldest state, and all entries since."""
        kept: list[bytes] = []
        for segment in self._segments:
            kept += segment.lines[1:] if kept else segment.lines
        return kept


def prune(folder: Path, own: Sequence[str]) -> None:
    """Remove the oldest files beyond `FILES_KEPT`; those in `own` count as the newest."""
    place = {name: i for i, name in enumerate(own, 1)}
    files = sorted(
        folder.glob("*.jsonl"), key=lambda file: (place.get(file.name, 0), file.name)
    )
    for old in files[:-FILES_KEPT]:
        old.unlink(missing_ok=True)


def read_messages(descriptor: int) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and the content of each message, until the gate has ended."""
    rest = b""
    for chunk in iter(partial(os.read, descriptor, CHUNK_BYTES), b""):
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            yield line[:1], line[1:] + b"\n"


def write_file(path: str, own: Sequence[str], lines: list[bytes]) -> str:
    """Write a file and prune its folder; return why that failed, or "".

    `own` are the names of this gate's files, oldest first.
    """
    try:
        write_parts(path, give_parts(lines))
        prune(Path(path).parent, own)
    except OSError as error:
        return str(error)
    return ""


def give_parts(lines: list[bytes]) -> Iterator[bytes]:
    """Yield the parts of a file. Raises TimeoutError once the gate waits no longer."""
    for part in append_checksum(lines):
        if GIVEN_UP.is_set():
            raise TimeoutError("it took too long")
        yield part


def answer(path: str, failed: str) -> None:
    """Tell the gate that a file is written, or why not."""
    with contextlib.suppress(OSError):  # the gate has ended
        os.write(1, json.dumps({"path": path, "failed": failed}).encode() + b"\n")


def serve(messages: Iterator[tuple[bytes, bytes]]) -> None:
    """Keep what the gate sends, and write it whenever the gate asks for it."""
    ring = Ring()
    for kind, content in messages:
        if kind == STATE:
            time_s, _, state = content.partition(b" ")
            ring.begin(float(time_s), state)
        elif kind == ENTRY:
            ring.add(content)
        else:
            order = json.loads(content)
            path = order["path"]
            answer(path, write_file(path, order["own"], ring.lines()))


def main() -> None:
    """Serve the gate until it ends; on SIGTERM, give up the files that are not written yet."""
    # writing files must not run at the gate's real-time priority
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(NICENESS)
    signal.signal(signal.SIGTERM, lambda *_: GIVEN_UP.set())
    serve(read_messages(0))


if __name__ == "__main__":
    main()
