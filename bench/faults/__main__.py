"""What is done to a run, and what is left of it: stages killed, disks filled, frames and files mutated, long streams.

`python -m bench.faults [--quick] [--json FILE] [--only kills,frames]`. Its parts lie in `bench/faulting/`.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil

from bench import faults as faulting
from bench.table import Row, main


def parts() -> list[str]:
    return sorted(module.name for module in pkgutil.iter_modules(faulting.__path__))


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--only", default="", help=f"parts, of {', '.join(parts())}; default: all")


def measure(options: argparse.Namespace) -> list[Row]:
    wanted = options.only.split(",") if options.only else parts()
    unknown = set(wanted) - set(parts())
    if unknown:
        raise SystemExit(f"--only={options.only}: the parts are {', '.join(parts())}")
    rows: list[Row] = []
    for name in wanted:
        print(f"{name} ...", flush=True)
        rows += importlib.import_module(f"bench.faults.{name}").measure(options.quick)
    return rows


if __name__ == "__main__":
    main(measure, "Faults, and what they leave", arguments)
