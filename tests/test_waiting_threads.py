"""Threads of libraries that wait cost other nodes nothing."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from launch.placement import thread_environment

SOLVES = """
import time, numpy as np
a, b = np.eye(300), np.ones(300)
began = time.process_time()
for _ in range(60):
    np.linalg.solve(a, b)
    time.sleep(0.005)
print(time.process_time() - began)
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one core: no library starts threads")
def test_numpys_threads_sleep_between_its_calls() -> None:
    def seconds(environment: dict[str, str]) -> float:
        clean = {name: value for name, value in os.environ.items() if not name.startswith("OPENBLAS_")}
        return float(subprocess.check_output([sys.executable, "-c", SOLVES], env=clean | environment))

    assert seconds(thread_environment(2)) < 0.5 * seconds({"OPENBLAS_NUM_THREADS": "2"})
