"""Files that are whole or not there: written aside, synced, renamed. Whoever dies on the way leaves the one before."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(file: Path, *, sync: bool = True) -> Iterator[Path]:
    """A path beside `file`, of the same suffix, to write to: when the block ends it takes the place of `file`.

    Where the block raises, `file` stays as it was and what was written aside is removed. Raises OSError. Without `sync`
    the disk is not waited for: whole whatever process dies, but not where the machine loses power.
    """
    aside = file.with_name(f".{file.stem}.{os.getpid()}{file.suffix}")
    try:
        yield aside
        if sync:
            sync_to_disk(aside)
        aside.replace(file)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    if sync:
        sync_to_disk(file.parent)  # the new name too outlives a loss of power


def parts_of(file: Path) -> list[Path]:
    """What processes that were killed while they wrote `file`, whose name may be a pattern, left aside."""
    found = file.parent.glob(f".{file.stem}.*{file.suffix}")
    return [p for p in found if p.name.removesuffix(file.suffix).rpartition(".")[2].isdecimal() and p.is_file()]


def replace_text(file: Path, text: str) -> None:
    """Writes a text file (UTF-8) in one step: readers see the old one or the new one. Raises OSError."""
    with replacing(file) as aside:
        aside.write_text(text, encoding="utf-8")


def sync_to_disk(path: Path) -> None:
    """Waits until a file, or the names in a folder, outlive a loss of power. Raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
