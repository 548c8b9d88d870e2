"""Which room may import which: none upward, no circle between files. An import inside a function counts too."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.support.shared_data import ROOT

GROUND = "mvsgs_core"  # the files right in it: what several rooms need, and all may import
PARAMETERS = "nodes/parameters.py"  # what a parameter is, which the contract speaks of
CONTRACT = "nodes/__init__.py"  # what a node is
DOOR = "mvsgs_core/__init__.py"  # by which a program finds the interface for programs, above all rooms of the core

# From the ground up: each room, its folders included, with those below it that it may import besides the ground.
ROOMS: dict[str, tuple[str, ...]] = {
    GROUND: (),
    "mvsgs_core/rasterizer": (),
    "mvsgs_core/networks": (),
    "mvsgs_core/scene": (),
    "mvsgs_core/datasets": ("mvsgs_core/scene",),
    "mvsgs_core/export": ("mvsgs_core/rasterizer", "mvsgs_core/datasets"),
    "mvsgs_core/mvs": ("mvsgs_core/networks",),
    "mvsgs_core/fusion": ("mvsgs_core/networks",),
    "mvsgs_core/tracking": ("mvsgs_core/networks",),
    "mvsgs_core/droid": ("mvsgs_core/networks", "mvsgs_core/tracking"),
    "mvsgs_core/photographs": ("mvsgs_core/tracking",),
    "mvsgs_core/mapping": ("mvsgs_core/rasterizer", "mvsgs_core/export"),
    "mvsgs_core/maps": ("mvsgs_core/tracking", "mvsgs_core/mapping"),
    "mvsgs_core/evaluation": (
        "mvsgs_core/rasterizer",
        "mvsgs_core/networks",
        "mvsgs_core/datasets",  # lenses
        "mvsgs_core/export",
        "mvsgs_core/mapping",
    ),
    "msgs": (),
    PARAMETERS: (),
    CONTRACT: ("msgs", PARAMETERS),
    "nodes/runtime": ("msgs", PARAMETERS, CONTRACT),
    "nodes/ros2": (),
    "nodes": ("msgs", CONTRACT, PARAMETERS, "nodes/runtime", "nodes/ros2", "mvsgs_core/*"),
    "launch": (
        "msgs",
        CONTRACT,
        PARAMETERS,
        "nodes/runtime",
        "mvsgs_core/datasets",
        "mvsgs_core/mapping",
        "mvsgs_core/evaluation",
    ),
    "mvsgs": ("msgs", CONTRACT, PARAMETERS, "nodes/runtime", "nodes", "launch", "mvsgs_core/*"),
    DOOR: ("mvsgs",),
    "examples": (
        "msgs",
        CONTRACT,
        PARAMETERS,
        "nodes/runtime",
        "nodes/ros2",
        "nodes",
        "mvsgs_core/datasets",
        "mvsgs_core/mapping",  # what a loss is given
        "mvsgs",
    ),
    "bench": ("msgs", CONTRACT, PARAMETERS, "nodes/runtime", "nodes/ros2", "nodes", "launch", "mvsgs_core/*"),
}


def files() -> dict[str, Path]:
    """All source files of the house, by the name under which they are imported."""
    found = {}
    for top in sorted({room.split("/")[0] for room in ROOMS}):
        for path in (ROOT / top).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def imports() -> dict[str, frozenset[str]]:
    """File -> files that it imports, wherever in it; paths from the root."""
    known = files()
    found = {}
    for name, path in known.items():
        named: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                package = name if path.name == "__init__.py" else name.rpartition(".")[0]
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                # `from package import file` is an import of the file, `from file import name` one of `file`
                named |= {f if (f := f"{base}.{alias.name}") in known else base for alias in node.names}
        found[_shown(path)] = frozenset(_shown(known[n]) for n in named if n in known and n != name)
    return found


def room(file: str) -> str:
    """The room that a file lies in: the longest name of one above it. Raises LookupError for none."""
    rooms = [r for r in ROOMS if r == file or (file.startswith(f"{r}/") and (r != GROUND or file.count("/") == 1))]
    if not rooms:
        raise LookupError(f"{file} lies in no room: enter its folder into ROOMS, with what it may import")
    return max(rooms, key=len)


def allowed(importing: str, imported: str) -> bool:
    below = (importing, GROUND, *ROOMS[importing])
    return imported in below or ("mvsgs_core/*" in below and imported.startswith("mvsgs_core/"))


@pytest.mark.slow
def test_every_import_goes_down() -> None:
    wrong = [
        f"{file} -> {other}: {room(file)} may import {', '.join((GROUND, *ROOMS[room(file)]))} only"
        for file, others in imports().items()
        for other in sorted(others)
        if not allowed(room(file), room(other))
    ]
    assert not wrong, "\n" + "\n".join(wrong)


def test_the_rooms_are_written_from_the_ground_up() -> None:
    above = list(ROOMS)
    wrong = [f"{r} -> {d}" for r, down in ROOMS.items() for d in down if d in above[above.index(r) :]]
    assert not wrong, wrong
    assert len(imports()) > 200
    assert {room(file) for file in imports()} == set(ROOMS)


def test_no_file_imports_itself_through_others() -> None:
    try:
        TopologicalSorter(imports()).prepare()
    except CycleError as error:
        pytest.fail("a circle of imports: " + " <- ".join(error.args[1]))


def _shown(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()
