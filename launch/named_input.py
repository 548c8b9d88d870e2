"""A bare word of a command line, `walk.mp4`, `photos/`, `rtsp://host/stream`, `0`, `camera`: which data set it is.

A file or folder is known by its name and layout, an address by its scheme; any other word is a choice of the slot.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from launch.refusal import GraphError
from mvsgs_core.datasets import recognized
from mvsgs_core.datasets.files import IMAGE_SUFFIXES, visible
from mvsgs_core.datasets.mcap_file import ROS_2, profile_of
from nodes.parameters import did_you_mean

SLOT = "dataset"
SCHEMES = {
    **dict.fromkeys(("rtsp", "rtsps", "rtmp", "rtp", "udp", "http", "https"), "camera"),
    **dict.fromkeys(("tcp", "ipc"), "robot"),
}
RECORDING = ".mcap"  # a recording of ours, or a bag of ROS 2
PREVIEW = ".lrv"  # a small copy that a camera puts beside its video: GL010001.LRV of GX010001.MP4
MAPS = (".ply", ".spz", ".splat")
# Hydra's own options that take a word of their own after them
_WITH_VALUE = ("--config-path", "-cp", "--config-name", "-cn", "--config-dir", "-cd", "--package", "-p", "--cfg", "-c",
               "--info", "-i")  # fmt: skip


def with_named_input(words: Sequence[str], choices: Sequence[str]) -> list[str]:
    """The command line with a bare word written as `dataset=` and `dataset.path=`, in its place.

    `choices`: those of the slot. A choice that the command line gives holds. Raises GraphError where it cannot be told
    what the word is, and for two of them.
    """
    places = [i for i, word in enumerate(words) if _bare(word) and (i == 0 or words[i - 1] not in _WITH_VALUE)]
    if not places:
        return list(words)
    if len(places) > 1:
        named = " and ".join(words[i] for i in places)
        raise GraphError(f"{named}: one input at a time; a parameter is written slot.parameter=value")
    place, keys = places[0], {word.partition("=")[0] for word in words}
    word = words[place]
    if f"{SLOT}.path" in keys:
        raise GraphError(f"{word}: the input is given twice, by {SLOT}.path, too")
    if SLOT in keys:
        meant = [f"{SLOT}.path={quoted(word)}"]
    else:
        meant = _meaning(word, choices)
    return [*words[:place], *meant, *words[place + 1 :]]


def _bare(word: str) -> bool:
    """No option and no override; an address may have a "=" in it, and the name of a file that is there."""
    return bool(word) and not word.startswith(("-", "~")) and ("=" not in word.partition("://")[0] or _exists(word))


def _exists(word: str) -> bool:
    try:
        return Path(word).exists()
    except (OSError, ValueError):  # too long for a name, or with a zero in it
        return False


def _is_device(word: str) -> bool:
    """A camera of this machine by its name, or what links to it now, as in /dev/v4l/by-id."""
    return word.startswith("/dev/") and re.fullmatch(r"/dev/video\d+", os.path.realpath(word)) is not None


def _meaning(word: str, choices: Sequence[str]) -> list[str]:
    scheme, separator, _ = word.partition("://")
    if separator:
        if scheme.lower() not in SCHEMES:
            raise GraphError(f"{word}: no address that is known; there are: {', '.join(f'{s}://' for s in SCHEMES)}")
        return _overrides(SCHEMES[scheme.lower()], word)
    if (word.isdecimal() and not _exists(word)) or _is_device(word):
        return _overrides("camera", word)
    path = Path(word).expanduser()
    try:
        if path.is_file():
            return _overrides(_of_file(path), word)
        if path.is_dir():
            return _overrides(_of_folder(path), word)
    except OSError as error:
        raise GraphError(f"{word}: {error.strerror or error}") from error
    if word in choices:
        return [f"{SLOT}={word}"]
    beside = [str(path.with_name(p.name)) for p in visible(path.parent, "*")]
    near = did_you_mean(word, [*choices, *beside])
    raise GraphError(
        f"{word}: there is no such file or folder here{near}; give a video, a folder of images, an address, a camera's "
        f"number, or one of: {', '.join(choices)}"
    )


def _of_file(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix == RECORDING:
        return "bag" if profile_of(path) == ROS_2 else "player"
    found = next(iter(recognized(path)), None)
    if found is not None:
        return found
    if suffix in MAPS:
        raise GraphError(f"{path}: is a map; `mvsgs view {path}` shows it, and `mvsgs export` turns it into others")
    if suffix in IMAGE_SUFFIXES:
        raise GraphError(f"{path}: one image makes no map; give the folder that it is in: {path.parent}")
    raise GraphError(f"{path}: its name does not say what it is; if it is a video: dataset=video dataset.path={path}")


def _of_folder(path: Path) -> str:
    if (path / "config.yaml").is_file() and any((path / name).exists() for name in ("report.json", "map.ply")):
        raise GraphError(f"{path}: is the output of a run; `mvsgs view {path}` shows its map, resume={path} goes on")
    found = recognized(path)
    if len(found) == 1:
        return found[0]
    if found:
        raise GraphError(f"{path}: is in the layouts of {' and '.join(found)}; say which with {SLOT}={found[0]}")
    within = sorted(visible(path, "*"), key=lambda inner: (inner.suffix.lower() == PREVIEW, inner))
    if not within:
        raise GraphError(f"{path}: is an empty folder")
    usable = [inner for inner in within if inner.suffix.lower() == RECORDING or _any(inner)]
    if usable:
        others = f" or {len(usable) - 1} more in it" if usable[1:] else ""
        raise GraphError(f"{path}: is no data set itself; give {usable[0]}{others}")
    raise GraphError(f"{path}: has neither images nor a data set in it, but {', '.join(p.name for p in within[:3])}")


def _any(path: Path) -> bool:
    try:
        return bool(recognized(path))
    except OSError:
        return False


def _overrides(choice: str, word: str) -> list[str]:
    return [f"{SLOT}={choice}", f"{SLOT}.path={quoted(word)}"]


def quoted(text: str) -> str:
    """Any text as a value of Hydra's grammar, in which nothing is an interpolation; in quotes unless it is plain."""
    if re.fullmatch(r"[A-Za-z_./][\w./-]*[./][\w./-]*", text, re.ASCII):
        return text
    text = re.sub(r"(\\*)'", r"\1\1\\'", text)
    text = re.sub(r"(\\+)$", r"\1\1", text)
    return "'" + text.replace("${", "\\${") + "'"
