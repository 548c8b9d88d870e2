"""`mvsgs keys DIR`: makes the CURVE keys that programs on several hosts know each other by; each gets a copy of DIR."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from launch.output import file_in_the_way
from nodes.runtime.transport import create_keys


def main(words: list[str] | None = None, prog: str = "mvsgs keys") -> int:
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR", help="is made where it is not there")
    folder: Path = parser.parse_args(words).folder
    try:
        if found := file_in_the_way(folder):
            raise NotADirectoryError(f"{folder}: {found}")
        create_keys(folder)
    except OSError as error:
        print(f"error: {folder}: {error.strerror}" if error.strerror else f"error: {error}", file=sys.stderr)
        return 1
    print(f"{folder}: a new pair of keys; copy it to each host with scp -pr")
    return 0
