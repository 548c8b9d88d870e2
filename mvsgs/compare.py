"""`mvsgs compare RUN RUN...`: runs side by side, their figures and, with --html, renders of the same keyframes."""

from __future__ import annotations

import argparse
from pathlib import Path

from launch.comparison import comparison_page, comparison_text
from mvsgs.evaluate import output_of
from mvsgs_core.atomic_file import replace_text
from mvsgs_core.export.command_line import run


def compare(options: argparse.Namespace) -> str:
    """Does what the command line asks. Raises ValueError and OSError."""
    outputs = [output_of(path) for path in options.runs]
    if len(outputs) < 2:
        raise ValueError("give two runs or more: their output folders")
    if len({output.resolve() for output in outputs}) < len(outputs):
        raise ValueError("a run is given twice")
    text = comparison_text(outputs)
    if options.html is not None:
        replace_text(options.html, comparison_page(outputs))
        text += f"\n{options.html}: the same with pictures"
    return text


def main(arguments: list[str] | None = None, prog: str = "mvsgs compare") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="output folders of runs")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page, with renders of the same keyframes")
    return run(parser, arguments, compare)
