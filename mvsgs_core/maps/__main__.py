"""`python -m mvsgs_core.maps info DIR`: what is in the map that a run with keep_map=true left in its output."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from mvsgs_core.maps.info import info


def main(arguments: list[str]) -> int:
    """The exit code: 2 where there is no map."""
    parser = argparse.ArgumentParser("python -m mvsgs_core.maps", description="Maps that runs with keep_map=true left.")
    commands = parser.add_subparsers(required=True)
    said = commands.add_parser("info", help="prints what is in one")
    said.add_argument("folder", type=Path, help="output directory of the run")
    options = parser.parse_args(arguments)
    try:
        print("\n".join(info(options.folder)))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
