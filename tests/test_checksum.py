"""The map is the same to the bit as when its checksum was recorded; see `tests.support.checksum`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.checksum import RECORDED, RUNS, checksum, machine

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("run", RUNS)
def test_the_map_is_the_same_to_the_bit(run: str, tmp_path: Path) -> None:
    recorded = json.loads(RECORDED.read_text()).get(machine())
    if recorded is None:
        pytest.skip(f"no checksum of a machine like this one ({machine()}): python -m tests.support.checksum adds it")
    assert checksum(run, tmp_path / "out") == recorded[run], "meant so? python -m tests.support.checksum records it"
