"""Lit scenes kept on the disk: building one takes seconds, and each process that films it would do so again."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import zipfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np

from mvsgs_core import native
from mvsgs_core.atomic_file import replacing
from mvsgs_core.cache_folder import cache_folder
from mvsgs_core.scene.lit import LitScene

LIMIT = 8  # scenes; of some 50 MB each


def kept(name: str, build: Callable[[], LitScene]) -> LitScene:
    """What `build` makes, from the disk where it lies there. name: of the scene and all that it depends on but code.

    A file that is damaged is made anew; where the disk is full or not ours, or there is no home, it is built each time.
    """
    where = folder()
    if where is None:
        return build()
    file = where / f"{hashlib.sha256((name + _code()).encode()).hexdigest()[:32]}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        with file.open("rb") as data, np.load(data, allow_pickle=False) as stored:
            scene = LitScene(**{field.name: stored[field.name] for field in fields(LitScene)})
        with contextlib.suppress(OSError):  # another user's folder, which can be read
            os.utime(file)
        return scene
    scene = build()
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file, sync=False) as aside:
            np.savez(aside, **vars(scene))
        for old in sorted(file.parent.glob("*.npz"), key=lambda found: -found.stat().st_mtime)[LIMIT:]:
            old.unlink()
    return scene


def folder() -> Path | None:
    cache = cache_folder()
    return cache and cache / "scenes"


@functools.cache
def _code() -> str:
    """Of what builds and lights: a scene of other code or libraries is another one."""
    kernel = native.load("scene").__file__
    files = [*sorted(Path(__file__).parent.glob("*.py")), Path(str(kernel))]
    digest = hashlib.sha256(f"{np.__version__} {cv2.__version__} {Path(str(kernel)).name}".encode())
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()
