"""The benchmarks there are: what `make bench` runs."""

from __future__ import annotations

import re

from tests.support.shared_data import ROOT

FILES = [*(ROOT / "bench").glob("*.py"), *(ROOT / "bench").glob("*/__main__.py")]
BENCHMARKS = sorted(
    file.parent.name if file.stem == "__main__" else file.stem
    for file in FILES
    if re.search(r"^ +main\(measure", file.read_text(), re.MULTILINE)
)
