"""The campaigns: long proofs of promises, with a short form and controls that must fail."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parent
