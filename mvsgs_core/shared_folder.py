"""Folders in which nobody's results are to lie among everything else: the root of the file system, and the home."""

from __future__ import annotations

import os
from pathlib import Path

ROOT, HOME = "the root of the file system", "your home folder"


def shared(folder: Path) -> str | None:
    """What such a folder is, by whatever name it is given; None: another one."""
    home = os.path.expanduser("~")  # noqa: PTH111  # raises nothing where a user has none
    for what, place in ((ROOT, Path("/")), (HOME, Path(home))):
        if folder.exists() and place.exists() and folder.samefile(place):
            return what
    return None


def refusal(folder: Path, what: str, results: str) -> str:
    """One line: `results`, as in "a run", go elsewhere. what: of `shared`."""
    return f"is {what}; {results} needs a folder of its own, such as {folder / 'runs' / 'first'}"
