"""The weight rule and the comparison of the reference outputs in ../shared/golden (its README states both)."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from tests.support.shared_data import shared


def folder(name: str) -> Path:
    return shared(f"golden/{name}")


def rule_weights(table: Path) -> dict[str, torch.Tensor]:
    """The state dict that the reference outputs were made with; each tensor's checksum is verified."""
    description = json.loads(table.read_text())
    state = {}
    for entry in description["tensors"]:
        key, shape = entry["key"], tuple(entry["shape"])
        if not entry["dtype"].startswith("float"):
            state[key] = torch.zeros(shape, dtype=getattr(torch, entry["dtype"]))
            continue
        if not shape:
            state[key] = torch.tensor(entry["value"], dtype=torch.float32)
            continue
        values = _fill(key, shape, description["gain"], description["salt"])
        assert zlib.crc32(values.astype("<f4").tobytes()) == entry["crc32"], key
        state[key] = torch.from_numpy(values)
    return state


def _fill(key: str, shape: tuple[int, ...], gain: float, salt: int) -> np.ndarray:
    generator = np.random.Generator(np.random.PCG64(zlib.crc32(key.encode()) + salt))
    n = np.sqrt(12.0) * (generator.random(shape) - 0.5)
    kind = key.rsplit(".", 1)[-1]
    if kind == "weight" and len(shape) > 1:
        values = np.sqrt(gain / np.prod(shape[1:])) * n
    elif kind == "weight" or kind == "running_var":
        values = 1 + 0.2 * n
    elif kind == "bias":
        values = 0.05 * n
    elif kind == "running_mean":
        values = 0.1 * n
    else:
        values = 0.5 * n
    return values.astype(np.float32)


def error(ours: Any, stored: np.ndarray) -> float:
    """max|ours - stored| / max|stored|."""
    ours = ours.detach().numpy() if isinstance(ours, torch.Tensor) else np.asarray(ours)
    assert ours.shape == stored.shape, (ours.shape, stored.shape)
    assert np.isfinite(ours).all()
    return float(np.abs(ours.astype(np.float64) - stored).max() / np.abs(stored).max())


@contextmanager
def recorded(net: nn.Module) -> Iterator[dict[str, torch.Tensor]]:
    """Fills a table with what each layer gives in its first call, of several values the first and `NAME.0`, `NAME.1`,
    and as `NAME:in` with what it takes first. Values are copies, so that what changes later does no harm."""
    table: dict[str, torch.Tensor] = {}

    def keep(name: str, value: Any) -> None:
        if isinstance(value, torch.Tensor):
            table.setdefault(name, value.detach().clone())
        elif isinstance(value, (list, tuple)):
            keep(name, value[0])
            for number, part in enumerate(value):
                keep(f"{name}.{number}", part)

    def hook(name: str) -> Callable[[nn.Module, Any, Any], None]:
        def take(module: nn.Module, given: Any, found: Any) -> None:
            keep(name, found)
            keep(f"{name}:in", given[0])

        return take

    handles = [module.register_forward_hook(hook(name)) for name, module in net.named_modules() if name]
    try:
        yield table
    finally:
        for handle in handles:
            handle.remove()


def checks(table: Path) -> dict[str, dict[str, Any]]:
    content: dict[str, dict[str, Any]] = json.loads(table.read_text())
    return content


def check_error(ours: torch.Tensor, stored: dict[str, Any]) -> float:
    """Of one layer's statistics and samples, over its largest value; of a batch the stored part, from its beginning."""
    count = int(np.prod(stored["shape"]))
    assert ours.numel() % count == 0, (ours.shape, stored["shape"])
    values = ours.detach().double().numpy().ravel()[:count]
    at = np.arange(8) * (count - 1) // 7
    found = np.array([values.mean(), values.std(), np.abs(values).max(), *values[at]])
    wanted = np.array([stored["mean"], stored["std"], stored["absmax"], *stored["samples"]])
    assert np.isfinite(found).all()
    return float(np.abs(found - wanted).max() / stored["absmax"])
