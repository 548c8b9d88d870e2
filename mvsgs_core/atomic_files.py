"""Files that are whole or not there: written aside, synced and renamed, so that no reader and no crash sees a part."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART = ".part"  # ending of what is being written


@contextmanager
def replacing(path: Path, *, sync: bool = True) -> Iterator[Path]:
    """Gives the path to write to; what was written there takes the place of `path` when the block ends.

    After an error `path` is what it was, and the part is removed. sync: wait for the disk, so that a machine that
    loses power has one of the two as well; without it that holds for the death of any process only. Raises OSError.
    """
    part = path.with_name(f".{path.name}{PART}")
    try:
        yield part
        if sync:
            _sync(part)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    if sync:
        _sync(path.parent)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
