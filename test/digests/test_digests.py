from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from .digests import DIGESTS, FILE, TOLERANCES

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = [str(ROOT / "benchmarks"), str(ROOT / "test" / "campaigns")]
BITS = 1e-9  # sums in another order may differ by this share


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(DIGESTS))
def test_what_the_package_computes_is_what_it_computed_before(name, monkeypatch):
    monkeypatch.setattr(sys, "path", [*SCRIPTS, *sys.path])
    kept = json.loads(FILE.read_text())[name]
    found = DIGESTS[name]()
    assert sorted(found) == sorted(kept)
    for part, values in found.items():
        assert_alike(values, kept[part], TOLERANCES.get(name, BITS), part)


def assert_alike(found, kept, tolerance, part):
    """Compares words as they are, and numbers within a tolerance that grows with their count."""
    if any(isinstance(value, str) for value in [*found, *kept]):
        assert found == kept, part
        return
    count = found[0] if len(found) > 1 else 1.0
    allowed = tolerance * np.sqrt(max(1.0, count))
    np.testing.assert_allclose(found, kept, rtol=tolerance, atol=allowed, err_msg=part)
