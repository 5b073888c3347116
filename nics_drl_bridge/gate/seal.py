"""The last line of a black box, with the checksum of all previous lines."""

import hashlib
from collections.abc import Iterable, Iterator

SEAL = b'{"sha256": "%b"}\n'


def append_checksum(lines: Iterable[bytes]) -> Iterator[bytes]:
    """Yields lines, then a line with their checksum, without keeping them in memory."""
    digest = hashlib.sha256()
    for line in lines:
        digest.update(line)
        yield line
    yield SEAL % digest.hexdigest().encode()
