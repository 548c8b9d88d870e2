"""Modules that a user names in a setting, such as `tracker._target_=my_tracker.Strided`: found where the user works;
and optional ones that are installed or not."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def import_named(name: str) -> ModuleType:
    """The module of that name: an installed one, or else one in the current directory.

    The current directory is not on `sys.path` before, and comes last from then on: a file there takes no other
    module's place. Raises ImportError where there is none, ValueError for an empty name, and what the module raises.
    """
    top = name.partition(".")[0]
    here = str(Path.cwd())
    if top and here not in sys.path and not _found(top):
        sys.path.append(here)
        importlib.invalidate_caches()
        if not _found(top):
            sys.path.remove(here)
    return importlib.import_module(name)


def is_installed(module: str) -> bool:
    """Whether an optional module is there: a folder of its name, as a clone beside this checkout, is not it."""
    spec = importlib.util.find_spec(module)
    return spec is not None and spec.origin is not None


def _found(top: str) -> bool:
    return top in sys.modules or importlib.util.find_spec(top) is not None


__all__ = ["import_named", "is_installed"]
