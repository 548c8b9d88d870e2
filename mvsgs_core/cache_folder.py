"""Where what can be had again is kept: downloaded weights, scenes that took seconds to build, compiled kernels."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
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


def written_folder(name: str) -> Path:
    """A folder of that, of this name, for who cannot do without one; a temporary one, which goes with this process,
    where it cannot be written."""
    if (cache := cache_folder()) is not None:
        try:
            (cache / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            pass
        else:
            if os.access(cache / name, os.W_OK | os.X_OK):
                return cache / name
    made = Path(tempfile.mkdtemp(prefix=f"mvsgs-{name}-"))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made
