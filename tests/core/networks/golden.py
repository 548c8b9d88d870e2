"""The weight rule and the comparison of the reference outputs in ../shared/golden (its README states both)."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tests.shared_data import shared


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
