from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from .digests import DIGESTS, FILE

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(DIGESTS))
def test_what_the_package_computes_is_what_it_computed_before(name, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    kept = json.loads(FILE.read_text())[name]
    found = DIGESTS[name]()
    assert sorted(found) == sorted(kept)
    for part, numbers in found.items():
        scale = np.sqrt(max(1.0, numbers[0]))
        np.testing.assert_allclose(
            numbers, kept[part], rtol=1e-9, atol=1e-9 * scale, err_msg=part
        )
