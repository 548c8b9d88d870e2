"""What is done to a run, and what is left of it: stages killed, disks filled, frames and files mutated, long streams.

`python -m bench.faults [--quick] [--json FILE] [--only kills,frames]`.
"""

from __future__ import annotations

import argparse
import importlib

from bench.table import Row, main, names

PARTS = ("equal", "files", "frames", "hours", "kills", "newest", "worst")  # modules of bench.faults


def arguments(parser: argparse.ArgumentParser) -> None:
    told = f"parts, of {', '.join(PARTS)}; default: all"
    parser.add_argument("--only", type=names(PARTS), default=list(PARTS), help=told)


def measure(options: argparse.Namespace) -> list[Row]:
    rows: list[Row] = []
    for name in options.only:
        print(f"{name} ...", flush=True)
        rows += importlib.import_module(f"bench.faults.{name}").measure(options.quick)
    return rows


if __name__ == "__main__":
    main(measure, "Faults, and what they leave", arguments)
