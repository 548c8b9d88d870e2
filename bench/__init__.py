"""Benchmarks, each `python -m bench.NAME`."""

import os

# As the launcher has it for nodes: NumPy's threads wait by spinning, which is counted as work.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
