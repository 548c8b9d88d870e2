"""`mvsgs eval RUN`: the figures of a run again, as they stood on the screen at its end.

`mvsgs eval RUN walk.mp4 ...` asks how well the map that a run kept (keep_map=true) explains another video or data set:
its frames are found in the map, which stays as it is, and are scored in a report of their own.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from launch.comparison import finished_report
from launch.named_input import quoted
from launch.summary import summary
from mvsgs.command import run_all
from mvsgs_core.export.command_line import run


def output_of(run: Path) -> Path:
    """The output folder of a run, which may be named by its map.ply."""
    return run.parent if run.is_file() else run


def evaluate(options: argparse.Namespace) -> str:
    """Raises ValueError for a folder without a finished report."""
    output = output_of(options.run)
    finished_report(output)
    return summary(output).lstrip("\n")


def main(arguments: list[str] | None = None, prog: str = "mvsgs eval") -> int:
    parser = argparse.ArgumentParser(
        prog=prog, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="output folder of a run, or its map.ply")
    words = sys.argv[1:] if arguments is None else arguments
    if words and not words[0].startswith("-") and words[1:]:
        return run_all([f"map={quoted(str(output_of(Path(words[0]))))}", "mapper=frozen", *words[1:]])
    return run(parser, arguments, evaluate)
