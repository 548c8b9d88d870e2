"""A map that a run left, for another run to begin on: where its two halves lie, and how its frames are numbered then.

    DIR/checkpoint/state-*.npz, keyframes/   the mapper's half: splats and keyframes, see mapping/checkpoints
    DIR/checkpoint/tracker.npz               the tracker's half: keyframes as it tracks them, see tracking/known_map.py

Frames are numbered from 0 in every stream. On a new stream the frames of the map's own are numbered from -`STREAM` on,
those of the stream before that from -2 `STREAM`: so they come before all new ones, and held-out frames stay those.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = "checkpoint"
TRACKER = "tracker.npz"
STREAM = 1_000_000_000  # frames, a multiple of HELD_OUT_EVERY


def tracker_file(output: Path | str) -> Path:
    """Of the map in a run's output directory."""
    return Path(output) / FOLDER / TRACKER


def check_kept_map(output: Path | str) -> None:
    """Raises ValueError, saying what to do, for an output directory of a run that kept no map."""
    if not Path(output).is_dir():
        raise ValueError(f"map={output}: no such directory; give the output directory of a run with keep_map=true")
    if not tracker_file(output).is_file():
        raise ValueError(
            f"map={output}: no map to begin on there ({FOLDER}/{TRACKER} is missing): that run had no keep_map=true, "
            "was not finished, or had a tracker that keeps none (tracker=dense does)"
        )


__all__ = ["FOLDER", "STREAM", "TRACKER", "check_kept_map", "tracker_file"]
