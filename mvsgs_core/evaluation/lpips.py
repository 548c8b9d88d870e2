"""LPIPS (Zhang et al. 2018), version 0.1 with the SqueezeNet 1.1 trunk: a distance of deep features, lower is closer.

The trunk matters: figures with the AlexNet or VGG trunk are other numbers. Weights are loaded from files, see
`mvsgs_core.weights`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mvsgs_core.bad_file import reading
from mvsgs_core.networks.checkpoints import read

_TAPS = (1, 4, 7, 9, 10, 11, 12)  # layers of the trunk whose outputs are compared
_CHANNELS = (64, 128, 256, 384, 384, 512, 512)


class _Fire(nn.Module):
    def __init__(self, inputs: int, squeeze: int, expand: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(inputs, squeeze, 1)
        self.expand1x1 = nn.Conv2d(squeeze, expand, 1)
        self.expand3x3 = nn.Conv2d(squeeze, expand, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = torch.relu(self.squeeze(x))
        return torch.cat([torch.relu(self.expand1x1(x)), torch.relu(self.expand3x3(x))], dim=1)


class Lpips(nn.Module):
    """`Lpips(trunk_file, head_file)(image, reference)`: images (B, 3, H, W) in 0..1, returns (B,)."""

    shift: Tensor
    scale: Tensor

    def __init__(self, trunk: Path, heads: Path) -> None:
        """Raises BadFileError where a file is damaged or does not hold the weights that it should."""
        super().__init__()
        pool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
        self.features = nn.Sequential(
            nn.Conv2d(3, 64, 3, stride=2),
            nn.ReLU(),
            pool,
            _Fire(64, 16, 64),
            _Fire(128, 16, 64),
            pool,
            _Fire(128, 32, 128),
            _Fire(256, 32, 128),
            pool,
            _Fire(256, 48, 192),
            _Fire(384, 48, 192),
            _Fire(384, 64, 256),
            _Fire(512, 64, 256),
        )
        self.heads = nn.ModuleList(nn.Conv2d(c, 1, 1, bias=False) for c in _CHANNELS)
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])
        _load(self.features, trunk, "features.", ignored=("classifier.",))
        _load(self.heads, heads, "lin", renamed=(".model.1.", "."))
        self.requires_grad_(False).eval()

    def compare(self, render: np.ndarray, photograph: np.ndarray) -> float:
        """The distance of two images (H, W, 3) float32 in 0..1."""
        return float(self(*(torch.from_numpy(i).permute(2, 0, 1)[None].contiguous() for i in (render, photograph))))

    @torch.inference_mode()
    def forward(self, image: Tensor, reference: Tensor) -> Tensor:
        x, y = ((2 * i - 1 - self.shift) / self.scale for i in (image, reference))
        distance = torch.zeros(len(image), device=image.device)
        heads = iter(self.heads)
        for k, layer in enumerate(self.features):
            x, y = layer(x), layer(y)
            if k in _TAPS:
                difference = (_unit(x) - _unit(y)) ** 2
                distance = distance + next(heads)(difference).mean(dim=(1, 2, 3))
        return distance


def _unit(features: Tensor) -> Tensor:
    return features / (features.norm(dim=1, keepdim=True) + 1e-10)


def _load(
    module: nn.Module, file: Path, prefix: str, renamed: tuple[str, str] = ("", ""), ignored: tuple[str, ...] = ()
) -> None:
    state = {
        key.removeprefix(prefix).replace(*renamed) if renamed[0] else key.removeprefix(prefix): value
        for key, value in read(file).items()
        if not key.startswith(ignored)
    }
    with reading(file, "does not hold the LPIPS weights expected there"):
        module.load_state_dict(state, strict=True)
