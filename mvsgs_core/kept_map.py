"""A map that a run left, for another run to begin on: where its two halves lie, and how its frames are numbered then.

    DIR/checkpoint/state-*.npz, keyframes/   the mapper's half: splats and keyframes, see mapping/checkpoints
    DIR/checkpoint/tracker.npz               the tracker's half: keyframes as it tracks them, see tracking/known_map.py

Frames are numbered from 0 in every stream. On a new stream the frames of the map's own are numbered from -`STREAM` on,
those of the stream before that from -2 `STREAM`: so they come before all new ones, and none is held out.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = "checkpoint"
TRACKER = "tracker.npz"
STREAM = 1_000_000_000  # frames: more than a stream has
NOTHING_MAPPED = "nothing is mapped yet: move the camera sideways until keyframes are mapped, and ask again"


def tracker_file(output: Path | str) -> Path:
    """Of the map in a run's output directory."""
    return Path(output) / FOLDER / TRACKER


def check_no_map(output: Path | str, *, returned: bool = False) -> None:
    """Raises ValueError, saying what to do, for a directory that has a map already: none is written over.

    returned: by a tracker that was killed and started again, for whom its own half alone is none: it did not get
    farther.
    """
    folder = Path(output) / FOLDER
    if folder.exists() and not (returned and [file.name for file in folder.iterdir()] == [TRACKER]):
        raise ValueError(f"{output}: there is a map already; give another folder")


def drop_tracker_half(output: Path | str) -> None:
    """Of a map whose other half was not written. Raises OSError."""
    file = tracker_file(output)
    file.unlink(missing_ok=True)
    for folder in (file.parent, Path(output)):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def check_kept_map(output: Path | str) -> None:
    """Raises ValueError, saying what to do, for an output directory of a run that kept no map."""
    if not Path(output).is_dir():
        raise ValueError(f"map={output}: no such directory; give the output directory of a run with keep_map=true")
    if not tracker_file(output).is_file():
        raise ValueError(
            f"map={output}: no map to begin on there ({FOLDER}/{TRACKER} is missing): that run had no keep_map=true, "
            "was not finished, or had a tracker that keeps none (tracker=dense does)"
        )


__all__ = [
    "FOLDER", "NOTHING_MAPPED", "STREAM", "TRACKER", "check_kept_map", "check_no_map", "drop_tracker_half",
    "tracker_file",
]  # fmt: skip
