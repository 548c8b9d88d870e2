"""A folder that a run has written in, told from others by its settings."""

from __future__ import annotations

from pathlib import Path

CONFIG = "config.yaml"  # all parameters, under the command that composed them
BEGINS = b"# mvsgs"  # as the command does: another program's settings begin otherwise


def has_settings(folder: Path) -> bool:
    """Whether a run's settings lie there."""
    try:
        with (folder / CONFIG).open("rb") as file:
            return file.read(len(BEGINS)) == BEGINS
    except OSError:
        return False
