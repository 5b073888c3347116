from __future__ import annotations

import pytest
from robots import direct_model

from middleware.rig import SECOND
from nics_drl_bridge.middleware.middleware import Middleware


@pytest.fixture
def middleware():
    """One that knows where its robot stands, and has heard nothing yet."""
    started = Middleware(direct_model())
    started.reset(SECOND, [1.0, 2.0, 0.5])
    return started
