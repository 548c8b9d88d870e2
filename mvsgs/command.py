"""`mvsgs walk.mp4`: maps what is named, as launch/run_all.py does; `mvsgs view MAP` and others: a word of the table."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mvsgs import WORKSPACE

RUN_ALL = WORKSPACE / "launch" / "run_all.py"
REFUSED = 2

USAGE = """\
Maps a video, a photo sequence or a live camera with Gaussian splats.

  mvsgs walk.mp4                 a video, a folder of images, a data set, a recording or bag
  mvsgs camera                   a live camera; also its number (0) or address (rtsp://host/stream, tcp://robot:5555)
  mvsgs dataset=tum dataset.path=DIR mapper.iterations=300 viewer=viser output=DIR
                                 any choice of any slot, any parameter
"""


@dataclass(frozen=True)
class Command:
    """What a first word does: `module.main(words, prog)`, or, without a module, run_all.py with words in its place."""

    takes: str
    does: str
    module: str = ""
    words: tuple[str, ...] = ()


COMMANDS = {
    "run": Command("INPUT ...", "the same as without this word"),
    "demo": Command("...", "maps the embedded room", words=("dataset=synthetic",)),
    "view": Command("MAP", "a saved map in the browser: keyframes, renders, depth", "mvsgs.view"),
    "eval": Command("RUN [INPUT ...]", "a run's figures again; its map's on other images", "mvsgs.evaluate"),
    "compare": Command("RUN RUN ...", "runs side by side, with --html also renders", "mvsgs.compare"),
    "info": Command("DIR", "what is in the map that a run kept, for map=DIR", "mvsgs_core.maps.info"),
    "export": Command("MAP OUT", "to .ply, .splat, .spz, .glb, .obj or a COLMAP folder", "mvsgs_core.export.__main__"),
    "render": Command("MAP PATH OUT.mp4", "a video along a trajectory", "mvsgs_core.export.render_path"),
    "doctor": Command("", "what this machine has for a run, and a self-test of ten seconds", "mvsgs.doctor"),
    "weights": Command("list", "network weights: where they are found and had", "mvsgs_core.weights"),
    "keys": Command("DIR", "makes the keys that hosts know each other by", "mvsgs.keys"),
    "graph": Command("...", "what a command line composes", words=("--graph",)),
    "parameters": Command("...", "all slots, choices and parameters of a command line", words=("--help",)),
}


def main(words: Sequence[str] | None = None) -> int:
    """Does what the command line asks; returns the exit code, see launch/outcome.py. A run takes its place."""
    words = list(sys.argv[1:] if words is None else words)
    if not words or words in (["-h"], ["--help"], ["help"]):
        print(usage())
        return 0
    first, rest = words[0], words[1:]
    command = COMMANDS.get(first)
    if command is None:
        _refuse_misspelled(first)
        return run_all(words)
    if not command.module:
        return run_all([*command.words, *rest])
    _put_path_in_order()
    from mvsgs_core.printable import not_utf8

    if problem := not_utf8([*rest, str(Path.cwd())]):
        print(f"error: {problem}", file=sys.stderr)
        return REFUSED
    code: int = importlib.import_module(command.module).main(rest, prog=f"mvsgs {first}")
    return code


def usage() -> str:
    lines = [f"  mvsgs {f'{name} {command.takes}':24} {command.does}" for name, command in COMMANDS.items()]
    return "\n".join([USAGE, *lines, "", "A MAP is a map.ply or the output folder of a run."])


def run_all(words: Sequence[str]) -> int:
    """Replaces this process by the launcher's."""
    if sys.stdout is not None:  # closed by who started this, as by `>&-`
        sys.stdout.flush()
    os.execv(sys.executable, [sys.executable, str(RUN_ALL), *words])


def _refuse_misspelled(word: str) -> None:
    """A word that is nearly a command, and nothing that could be mapped."""
    if "=" in word or word.startswith("-") or Path(word).exists():
        return
    _put_path_in_order()
    from launch.compose import choices_of
    from nodes.parameters import did_you_mean

    near = did_you_mean(word, [*COMMANDS, *choices_of("dataset")])
    if any(near == did_you_mean(name, [name]) for name in COMMANDS):
        print(f"error: {word}: no command, file or folder{near}", file=sys.stderr)
        raise SystemExit(REFUSED)


def _put_path_in_order() -> None:
    """The workspace first, and the current directory out: nothing among a user's data takes a module's place."""
    here = {"", str(Path.cwd())} - {str(WORKSPACE)}
    sys.path[:] = [str(WORKSPACE)] + [path for path in sys.path if path not in (*here, str(WORKSPACE))]
