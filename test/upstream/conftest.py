from __future__ import annotations

import itertools
from contextlib import ExitStack

import pytest


@pytest.fixture
def launch(tmp_path):
    """Starts a launch file, `launch(file, **arguments)`; it ends with the test."""
    from domains import claimed_domain

    from upstream.launched import Launched

    numbers = itertools.count()
    with ExitStack() as started:
        domain_id = started.enter_context(claimed_domain())

        def start(file, **arguments):
            folder = tmp_path / str(next(numbers))
            folder.mkdir()
            return started.enter_context(Launched(file, folder, domain_id, **arguments))

        yield start
