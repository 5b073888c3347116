"""What a campaign is written with: that of the benchmarks, which lie in another folder."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "benchmarks"))

from measuring.verdict import answer, parser_of  # noqa: E402

__all__ = ["ROOT", "answer", "parser_of"]
