import ctypes
import subprocess
import sys

import numpy as np
import pytest

from nodes.runtime.freed_memory import PERIOD, SHARE, FreedMemory
from nodes.runtime.status import rss
from tests.support.shared_data import ROOT

HAS_TRIM = hasattr(ctypes.CDLL(None), "malloc_trim")


def test_memory_is_given_back_once_a_period() -> None:
    now = [100.0]
    freed = FreedMemory(lambda: now[0])
    assert not freed.give_back()
    now[0] += PERIOD
    assert freed.give_back() == HAS_TRIM
    assert not freed.give_back()


def test_slow_returns_are_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    freed = FreedMemory(lambda: now[0])

    def slow(_: int) -> None:
        now[0] += 0.1

    monkeypatch.setattr(freed, "_trim", slow)
    now[0] += PERIOD
    assert freed.give_back()
    now[0] += 0.9 * 0.1 / SHARE
    assert not freed.give_back()
    now[0] += 0.2 * 0.1 / SHARE
    assert freed.give_back()


@pytest.mark.skipif(not HAS_TRIM, reason="this C library has no malloc_trim")
def test_what_was_freed_between_blocks_that_are_kept_goes_back_to_the_system() -> None:
    blocks = [np.ones(100_000, np.uint8) for _ in range(1000)]  # under glibc's smallest threshold: all on the heap
    kept = blocks[::10]
    del blocks
    held = rss()
    now = [0.0]
    freed = FreedMemory(lambda: now[0])
    now[0] = PERIOD
    assert freed.give_back()
    assert rss() < held - 50e6
    assert len(kept) == 100


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this C library has no mallopt")
def test_large_blocks_go_back_at_once() -> None:
    """Though small ones lie between them, and a larger one was freed before. In a process: it is for good."""
    code = """
import numpy as np
from nodes.runtime.freed_memory import return_large_blocks
from nodes.runtime.status import rss
from tests.support.shared_data import ROOT
del (large := [np.ones(30 * 2**20, np.uint8)])[:]
return_large_blocks()
blocks, between = [], []
for _ in range(20):
    blocks.append(np.ones(4 * 2**20, np.uint8))
    between.append(np.ones(5000, np.uint8))
held = rss()
del blocks
print(held - rss())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert int(done.stdout) > 70e6
