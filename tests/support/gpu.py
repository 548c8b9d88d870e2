"""Where tests of what a GPU does run: on a pretended one everywhere, and on a real one where there is one."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike

from tests.support.pretend_device import DEVICE, PretendDevice

NEEDS_GPU = (pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here"))
GPU = pytest.param("cuda", marks=NEEDS_GPU)
DEVICES = (DEVICE, GPU)


def on(device: str) -> AbstractContextManager[object]:
    """Where `device` is the pretended one, it is there inside."""
    return PretendDevice() if device == DEVICE else nullcontext()


def assert_same(device: str, there: ArrayLike, here: ArrayLike) -> None:
    """To the bit on the pretended device. A GPU rounds otherwise, by which what lies at a threshold falls elsewhere."""
    if device == DEVICE:
        np.testing.assert_array_equal(there, here)
    else:
        assert np.shape(there) == np.shape(here)
        assert np.isclose(there, here, rtol=1e-3, atol=1e-4, equal_nan=True).mean() >= 0.99
