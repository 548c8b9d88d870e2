"""A headless Chromium for a test, which is skipped where there is none."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from bench import chromium
from bench.chromium import Browser as Browser


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """A browser with an empty page, ended with the block."""
    try:
        chromium.executable()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    with chromium.browser() as page:
        yield page
