"""What all tests share.

One thread a process, as `make test` has it: sums come out alike, and tests that run at once do not wait for each other.
Triton's kernels run in its interpreter where there is no GPU. Both are decided when torch and Triton are imported.
"""

import gc
import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# how long one example takes says more of the machine than of the code
settings.register_profile("unhurried", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("unhurried")


@pytest.fixture(autouse=True, scope="module")
def what_is_left_open_fails_its_own_file() -> Iterator[None]:
    """Warnings are errors, and of what nobody closed the collector warns, wherever it happens to run."""
    yield
    gc.collect()
    gc.freeze()  # what stays, mostly libraries, is not looked through again after every file


def pytest_sessionfinish() -> None:
    gc.unfreeze()
