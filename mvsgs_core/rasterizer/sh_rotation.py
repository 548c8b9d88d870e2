"""Rotating spherical harmonics, so that a splat that turns with its keyframe keeps its view-dependent color."""

from __future__ import annotations

import functools

import numpy as np
import torch

from mvsgs_core.rasterizer.spherical_harmonics import basis, degree_of


def sh_rotation(rotation: np.ndarray, bases: int) -> np.ndarray:
    """Matrix (B, B) float64 for coefficients (B, 3): color'(R d) = color(d) for every direction d.

    rotation: (3, 3). The basis of each degree maps to itself under rotation, so that a least-squares fit over more
    directions than coefficients is exact.
    """
    degree = degree_of(bases)
    directions = _directions()
    turned = basis(torch.from_numpy(directions @ rotation.T), degree).numpy()
    original = basis(torch.from_numpy(directions), degree).numpy()
    matrix, *_ = np.linalg.lstsq(turned, original, rcond=None)
    return np.asarray(matrix)


@functools.cache
def _directions(count: int = 64) -> np.ndarray:
    """(count, 3) unit directions, evenly spread (golden spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
