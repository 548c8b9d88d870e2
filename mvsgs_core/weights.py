"""Where network weights are found: a folder named by $MVSGS_WEIGHTS, or the user's cache."""

from __future__ import annotations

import os
from pathlib import Path


def folders() -> list[Path]:
    """Folders that are searched, in order."""
    given = [Path(p) for p in os.environ.get("MVSGS_WEIGHTS", "").split(os.pathsep) if p]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "mvsgs" / "weights"
    return [*given, cache]


def find(*names: str) -> Path | None:
    """The first existing file among `names` (paths relative to the folders), or None."""
    for folder in folders():
        for name in names:
            if (folder / name).is_file():
                return folder / name
    return None
