"""Where what can be had again is kept: downloaded weights, scenes that took seconds to build."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path | None:
    """This project's folder of XDG_CACHE_HOME (an absolute path, by its specification), else of `~/.cache`.

    None where there is neither: a container's user may have no home and no name.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (given if given.is_absolute() else Path.home() / ".cache") / "mvsgs"
    except RuntimeError:
        return None
