"""Program that writes a black box: `black_box_writer FOLDER NAME...`, lines on standard input.

The gate starts it at a stop. NAMES are those of the gate's files, oldest first; the last one is
written, and the oldest files of the folder are removed. A failure is told on standard error.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from nics_drl_bridge.files import write_parts
from nics_drl_bridge.gate.seal import append_checksum

FILES_KEPT = 20
NICENESS = 5
OVERDUE_S = 25  # a disk that takes longer hangs; SIGALRM ends the program then [s]


def prune(folder: Path, own: Sequence[str]) -> None:
    """Remove the oldest files beyond `FILES_KEPT`; those in `own` count as the newest."""
    place = {name: i for i, name in enumerate(own, 1)}
    files = sorted(
        folder.glob("*.jsonl"), key=lambda file: (place.get(file.name, 0), file.name)
    )
    for old in files[:-FILES_KEPT]:
        old.unlink(missing_ok=True)


def main(folder: str, *own: str) -> None:
    """Write the last file of `own`, and end with a sentence if that fails."""
    signal.alarm(OVERDUE_S)
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    try:
        write_parts(Path(folder) / own[-1], append_checksum(sys.stdin.buffer))
        prune(Path(folder), own)
    except OSError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(*sys.argv[1:])
