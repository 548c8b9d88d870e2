"""The bytes of a .spz (Niantic's format), of the version that every viewer reads: packed columns, gzip around them."""

from __future__ import annotations

import gzip
import struct

import numpy as np

STEP = 1.0 / 4096.0  # positions are multiples of this
REACH = 2048.0  # in 24 bits
ANTIALIASED = 1  # of the flags
_MAGIC, _VERSION, _FRACTION_BITS = 0x5053474E, 2, 12
_COLOR = 0.15  # of the harmonics' constant term, in the whole range of a byte
_BANDS = ((1, 8), (4, 16), (9, 16), (16, 16))  # harmonics from that one on are multiples of so many steps of a byte


def packed(
    means: np.ndarray, log_scales: np.ndarray, quaternions: np.ndarray, opacity: np.ndarray, harmonics: np.ndarray,
    antialiased: bool,
) -> bytes:  # fmt: skip
    """means, log_scales (N, 3), quaternions (N, 4) w first, opacity (N,) 0 to 1, harmonics (N, B, 3); in its axes."""
    count, bases = len(means), harmonics.shape[1]
    degree = round(bases**0.5) - 1
    fixed = np.round(means / STEP).astype("<i4").reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3]
    color = 255.0 * (_COLOR * harmonics[:, 0] + 0.5)
    turned = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    turned = np.where(turned[:, :1] < 0, -turned, turned)[:, 1:]  # w follows from the others
    rest = np.round(128.0 * harmonics[:, 1:]) + 128.0
    for first, step in _BANDS[:degree]:
        band = rest[:, first - 1 : (round(first**0.5) + 1) ** 2 - 1]
        band[:] = np.floor((band + step / 2) / step) * step
    columns = (255.0 * opacity, color, 16.0 * (log_scales + 10.0), 127.5 * (turned + 1.0), rest)
    head = struct.pack("<3I4B", _MAGIC, _VERSION, count, degree, _FRACTION_BITS, ANTIALIASED * antialiased, 0)
    body = b"".join(np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes() for values in columns)
    return gzip.compress(head + fixed.tobytes() + body, mtime=0)


__all__ = ["REACH", "STEP", "packed"]
