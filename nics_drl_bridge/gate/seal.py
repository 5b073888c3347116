"""The last line of a black box, which holds the checksum of all lines before."""

import hashlib
from collections.abc import Iterable, Iterator

SEAL = b'{"sha256": "%b"}\n'


def append_checksum(lines: Iterable[bytes]) -> Iterator[bytes]:
    """Yields lines, and then the line with their checksum: memory must not grow at a stop."""
    digest = hashlib.sha256()
    for line in lines:
        digest.update(line)
        yield line
    yield SEAL % digest.hexdigest().encode()
