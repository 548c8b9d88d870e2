"""Memory that is not there is said by every kernel whose threads ask for some, and ends no process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.shared_data import ROOT
from tests.support.starved_kernels import ENVIRONMENT, KERNELS


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="its memory is bounded as Linux bounds it")
@pytest.mark.parametrize("name", KERNELS)
def test_memory_that_is_not_there_ends_no_process(name: str) -> None:
    command = [sys.executable, "-m", "tests.support.starved_kernels", name]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 1
