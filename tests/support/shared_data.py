"""Real sequences, weights and reference outputs lie outside the project, in ../shared; without them tests skip."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def shared(relative: str) -> Path:
    """Path of ../shared/<relative> ($MVSGS_SHARED/<relative> if set); skips the calling test where it is missing."""
    path = Path(os.environ.get("MVSGS_SHARED", ROOT.parent / "shared")) / relative
    if not path.exists():
        pytest.skip(f"{path} is missing: set MVSGS_SHARED to a folder with data/, weights/ and golden/")
    return path
