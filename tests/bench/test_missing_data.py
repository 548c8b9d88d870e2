"""No table leaves a video out in silence."""

from __future__ import annotations

import argparse

import pytest

from bench import fixed_parts, focal, lost, moving
from bench.tracking.cases import Case

MISSING = {"walk": Case("tum", folder="nowhere")}


@pytest.mark.parametrize("benchmark", [focal, fixed_parts, moving, lost])
def test_a_video_whose_data_is_not_there_is_said(benchmark: object, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("QUICK", "VIDEOS", "SCENES"):
        monkeypatch.setattr(benchmark, name, MISSING, raising=False)
    monkeypatch.setattr(benchmark, "summary", lambda _: [], raising=False)
    monkeypatch.setattr(benchmark, "STRAIGHT", MISSING["walk"], raising=False)
    rows = benchmark.measure(argparse.Namespace(quick=False, scenes=None))  # type: ignore[attr-defined]
    (row,) = [row for row in rows if row.name == "walk: skipped"]
    assert str(row.value).endswith("nowhere is missing")
