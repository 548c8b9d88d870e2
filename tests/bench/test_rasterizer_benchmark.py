"""How bench.rasterizer times what it compares."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from bench import rasterizer
from bench.rasterizer import PASSES, Roofline, Times, Work


def test_one_thread_is_timed_as_often_as_several_and_before_the_plain_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which fill the caches with what the kernel does not need."""
    order: list[str] = []

    def run(splats: Any, size: Any, kernel: str, backend: str, threads: int, times: Times) -> torch.Tensor:
        order.append(f"{threads} of {kernel}")
        times.add(1.0 / threads, 0.0)
        return torch.zeros(1)

    def plain(splats: Any, size: Any, kernel: str, threads: int, times: Times) -> torch.Tensor:
        order.append(f"plain of {kernel}")
        times.add(9.0, 0.0)
        return torch.zeros(1)

    monkeypatch.setattr(rasterizer, "scene", lambda *_: None)
    monkeypatch.setattr(rasterizer, "work", lambda *_: Work(2, 1, 1))
    monkeypatch.setattr(rasterizer, "roofline", lambda *_: Roofline(1.0, 1.0, 1.0))
    monkeypatch.setattr(rasterizer, "run", run)
    monkeypatch.setattr(rasterizer, "run_baseline", plain)
    rows = {row.name: row for row in rasterizer.compare((240, 320), 20_000, 2, 1)}
    assert order[: 2 * PASSES + 1] == ["2 of gaussian", "1 of gaussian"] * PASSES + ["plain of gaussian"]
    assert [step for step in order if "ges_scale" in step] == ["2 of ges_scale"] * PASSES
    assert rows["320x240 20k gaussian: times faster than with 1 thread"].value == pytest.approx(2.0)
