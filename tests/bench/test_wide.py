"""Scenes of bench.wide that are measured at several times."""

from __future__ import annotations

from pathlib import Path

from bench.table import Row
from bench.wide import in_pieces


def test_what_was_measured_is_kept_and_what_is_missing_named(tmp_path: Path) -> None:
    asked: list[str] = []

    def measured(name: str) -> list[Row]:
        asked.append(name)
        return [Row(f"{name}: parts", len(asked))]

    late = in_pieces(["a", "b"], tmp_path, resume=True, minutes=-1.0, measured=measured)
    assert [row.value for row in late] == ["a, b"]
    assert in_pieces(["a"], tmp_path, resume=True, minutes=None, measured=measured) == [Row("a: parts", 1)]
    both = in_pieces(["a", "b"], tmp_path, resume=True, minutes=None, measured=measured)
    assert both == [Row("a: parts", 1), Row("b: parts", 2)]
    anew = in_pieces(["a"], tmp_path, resume=False, minutes=None, measured=measured)
    assert anew == [Row("a: parts", 3)]
    assert asked == ["a", "b", "a"]
