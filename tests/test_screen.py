"""What the table of a run shows on terminals of all widths."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from launch.screen import LiveScreen, PlainScreen, make_screen
from launch.status import NodeStatus

NODES = {
    "depth_fusion": NodeStatus(
        "depth_fusion", "starting", received={"Depth": 12345}, queue={"Depth": 4}, sent={"FusedKeyframe": 123},
        counts={"keyframes": 12}, memory=2e8,
    ),
    "mapper": NodeStatus(
        "mapper", "running", received={"FusedKeyframe": 123}, counts={"views": 12}, memory=9e8,
        values={"splats": 20483, "iterations": 2981}, skipped={"splats_unseen": 3, "pixels_explored": 4e6, "more": 1},
    ),
}  # fmt: skip
ALWAYS = ["node", "state", "progress"]
COUNTS = ["in", "queue", "out"]
LOAD = ["cpu", "memory"]


def shown(width: int) -> list[str]:
    """The lines of the table."""
    file = io.StringIO()
    screen = LiveScreen(Console(file=file, width=width))
    screen._nodes, screen._processes, screen._began = NODES, {}, 0.0
    screen.console.print(screen._table())
    return [line for line in file.getvalue().splitlines() if line[0] in "┏┃┡│└"]


@pytest.mark.parametrize(
    ("width", "columns"),
    [
        (40, ALWAYS),
        (60, ALWAYS),
        (80, [*ALWAYS, *COUNTS]),
        (100, [*ALWAYS, *COUNTS, *LOAD]),
        (120, [*ALWAYS, *COUNTS, "skipped", *LOAD]),
        (200, [*ALWAYS, *COUNTS, "skipped", *LOAD]),
    ],
)
def test_columns_that_have_no_room_are_left_out_and_the_others_whole(width: int, columns: list[str]) -> None:
    lines = shown(width)
    assert set(lines[1].strip("┃").replace("┃", " ").split()) == set(columns)
    assert len({len(line) for line in lines}) == 1
    assert len(lines[0]) <= width
    assert {line[-1] for line in lines} == set("┓┃┩│┘"), "the right border"
    cells = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines if line.startswith("│")]
    assert [row[:2] for row in cells if row[0]] == [["depth_fusion", "starting"], ["mapper", "running"]]
    if "memory" in columns:
        assert [row[-1] for row in cells if row[0]] == ["191 MB", "858 MB"]
    if "skipped" in columns:
        assert len([row for row in cells if row[-3]]) == 1, "in one line, as its rest is in the report"


def test_lines_are_for_who_has_no_terminal_with_room_for_a_table() -> None:
    for terminal, width, kind in ((True, 80, LiveScreen), (True, 60, PlainScreen), (False, 200, PlainScreen)):
        console = Console(file=io.StringIO(), force_terminal=terminal, width=width)
        assert type(make_screen("auto", console)) is kind
    assert type(make_screen("live", Console(file=io.StringIO(), width=60))) is LiveScreen
