"""`mvsgs eval RUN`: the figures of a run again, as they stood on the screen at its end."""

from __future__ import annotations

import argparse
from pathlib import Path

from launch.comparison import finished_report
from launch.summary import summary
from mvsgs_core.export.command_line import run


def evaluate(options: argparse.Namespace) -> str:
    """Raises ValueError for a folder without a finished report."""
    output: Path = options.run.parent if options.run.is_file() else options.run
    finished_report(output)
    return summary(output).lstrip("\n")


def main(arguments: list[str] | None = None, prog: str = "mvsgs eval") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("run", type=Path, help="output folder of a run, or its map.ply")
    return run(parser, arguments, evaluate)
