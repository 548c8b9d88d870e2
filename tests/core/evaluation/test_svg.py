"""Plots as SVG text."""

from __future__ import annotations

import re

import numpy as np

from mvsgs_core.evaluation import svg


def legend(names: list[str]) -> list[tuple[int, int, str]]:
    """Left edge, top edge and color of each entry; none lies in the plot."""
    x = np.arange(5.0)
    drawn = svg.plot([svg.Series(name, x, x + 30.0) for name in names], "frame", "dB", width=480, height=300)
    found = re.findall(r'<rect x="(\d+)" y="(\d+)" width="10" height="10" fill="(#\w+)"/>', drawn)
    below = min(float(y) for y in re.findall(r'y1="([\d.]+)"', drawn))
    assert all(int(y) + 10 < below for _, y, _ in found)
    return [(int(x), int(y), color) for x, y, color in found]


def test_the_names_of_runs_do_not_lie_on_each_other() -> None:
    """As `mvsgs compare --html` names them: 29 letters of some 6 pixels."""
    entries = legend([f"2026-11-28_02-2{k}-44-synthetic" for k in range(8)])
    assert len({y for _, y, _ in entries}) == 8
    assert len({color for _, _, color in entries}) == 8


def test_short_names_share_a_line() -> None:
    assert [(x, y) for x, y, _ in legend(["truth", "estimate", "first"])] == [(70, 8), (200, 8), (330, 8)]
    assert [(x, y) for x, y, _ in legend(["truth", "a name of twenty-five", "third", "4th"])] == [
        (70, 8), (247, 8), (70, 24), (247, 24),
    ]  # fmt: skip
