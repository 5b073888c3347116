"""DDS domains for tests: one each, also beside other workers and other runs on this machine."""

from __future__ import annotations

import fcntl
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nics_drl_bridge.nodes.transport import find_used_domains

DOMAINS = range(1, 102)  # above, DDS ports may collide with those that Linux hands out


@contextmanager
def claimed_domain() -> Iterator[int]:
    """A domain id that nobody uses or has asked for here; freed when the block or process ends."""
    folder = Path(tempfile.gettempdir()) / "nics_drl_bridge_test_domains"
    folder.mkdir(exist_ok=True)
    unused = sorted(set(DOMAINS) - find_used_domains())
    for domain_id in random.sample(unused, len(unused)):
        with (folder / str(domain_id)).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield domain_id
            return
    raise RuntimeError(f"all {len(DOMAINS)} domains are claimed in {folder}")
