"""The windows that matching costs compare, in PyTorch."""

from __future__ import annotations

import torch
from torch import Tensor


class Windows:
    """Adaptive windows of a reference (Yoon and Kweon 2006): normalized weights (taps, H, W), mean and variance."""

    def __init__(self, image: Tensor, radius: int, noise: float, contrast: float) -> None:
        """image (H, W) gray levels; noise and contrast: as in CostConfig."""
        self.radius, self.noise = radius, noise
        side = range(-radius, radius + 1)
        far = [-0.5 * (dy * dy + dx * dx) / (radius + 1) ** 2 for dy in side for dx in side]
        self.taps = self.taps_of(image)  # (taps, H, W) gray levels
        inside = self.taps_of(torch.ones_like(image))
        distance = torch.tensor(far, device=image.device)
        weight = torch.exp(distance[:, None, None] - (self.taps - image).abs() / contrast) * inside
        self.weight = weight / weight.sum(dim=0)
        self.weighted = self.weight * self.taps
        self.mean = self.weighted.sum(dim=0)
        square = (self.weighted * self.taps).sum(dim=0)
        self.variance = (square - self.mean**2).clamp(min=0.0) + noise

    def taps_of(self, image: Tensor) -> Tensor:
        """(taps, H, W): each pixel's window of an image (H, W), 0 outside."""
        side = 2 * self.radius + 1
        height, width = image.shape
        columns = torch.nn.functional.unfold(image[None, None], side, padding=self.radius)
        return columns.reshape(side * side, height, width)

    def correlate(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """(H, W) ZNCC against what a neighbor shows in each window, (taps, H, W); and the mean of that."""
        total = (self.weight * samples).sum(dim=0)
        square = (self.weight * samples * samples).sum(dim=0)
        product = (self.weighted * samples).sum(dim=0)
        variance = (square - total**2).clamp(min=0.0) + self.noise
        return (product - self.mean * total) / torch.sqrt(self.variance * variance), total
