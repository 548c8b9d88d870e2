"""Where `launch`, `nodes` and `msgs` are found: in a wheel beside this file, in a checkout beside its folder."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

_PACKED = Path(__file__).resolve().parent / "workspace"
WORKSPACE = _PACKED if _PACKED.is_dir() else Path(__file__).resolve().parents[1]
ROOMS = ("msgs", "nodes", "launch")


def open_workspace() -> None:
    """Loads them for a program that is not ours, whose `sys.path` stays as it was.

    Raises ImportError where the program has a module of such a name already: it would be taken for ours.
    """
    sys.path.insert(0, str(WORKSPACE))
    try:
        for name in ROOMS:
            found = Path(importlib.import_module(name).__file__ or "").resolve()
            if found.parent != WORKSPACE / name:
                raise ImportError(
                    f"mvsgs has a module {name!r}, and this program has another one of that name: {found}; rename "
                    "yours, or map in a process of its own (the command mvsgs, with dataset=robot for your frames)"
                )
    finally:
        sys.path.remove(str(WORKSPACE))


__all__ = ["WORKSPACE", "open_workspace"]
