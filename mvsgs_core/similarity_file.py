"""The similarity from a map to another frame of reference, and what is known of it, in a JSON file of a format."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvsgs_core.atomic_file import replace_text
from mvsgs_core.bad_file import reading
from mvsgs_core.geometry import Similarity

VERSION = 1


def write_similarity(path: Path, format: str, frame: str, values: Mapping[str, Any]) -> None:
    """Replaces `path` atomically. frame: in words, what the similarity says; values: `scale`, `rotation`, `translation`
    and others, as JSON has them. Raises OSError."""
    content = {"format": format, "version": VERSION, "frame": frame, **values}
    replace_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_similarity(path: Path, format: str) -> tuple[dict[str, Any], Similarity]:
    """What `write_similarity` wrote. Raises BadFileError, saying what is wrong with it, and OSError."""
    with reading(path, f"is no {path.name} of this program"):
        content = json.loads(path.read_text(encoding="ascii"))
        if content["format"] != format or content["version"] != VERSION:
            raise ValueError(f"{content['format']!r} of version {content['version']!r}: version {VERSION} is read")
        rotation, translation = (np.array(content[name], np.float64) for name in ("rotation", "translation"))
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise ValueError("its rotation is none")
        if translation.shape != (3,) or not np.isfinite(translation).all():
            raise ValueError("its translation is no three finite numbers")
        if not 0.0 < float(content["scale"]) < math.inf:
            raise ValueError("its scale is not positive")
        return content, Similarity(float(content["scale"]), rotation, translation)


__all__ = ["read_similarity", "write_similarity"]
