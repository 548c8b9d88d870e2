"""DINO ViT-S/16 (Caron et al. 2021) and the decoder that joins its last attention map: MVSFormer's "-P" variant."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.twins import Mlp

DIM, HEADS, DEPTH, PATCH, EPS = 384, 6, 12, 16, 1e-6
_TRAINED_GRID = 14  # patches along an axis of the 224x224 images that the position embedding was trained with


class _Attention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.qkv, self.proj = nn.Linear(DIM, 3 * DIM), nn.Linear(DIM, DIM)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        b, n, _ = x.shape
        q, k, v = self.qkv(x).view(b, n, 3, HEADS, -1).permute(2, 0, 3, 1, 4)
        attention = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).softmax(dim=-1)
        return self.proj((attention @ v).transpose(1, 2).reshape(b, n, DIM)), attention


class _Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(DIM, eps=EPS), _Attention()
        self.norm2, self.mlp = nn.LayerNorm(DIM, eps=EPS), Mlp(DIM, 4 * DIM)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        y, attention = self.attn(self.norm1(x))
        x = x + y
        return x + self.mlp(self.norm2(x)), attention


class _PatchEmbedding(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, DIM, PATCH, PATCH)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.proj(x).flatten(2).transpose(1, 2)
        return y


class DinoSmall(nn.Module):
    """(N, 3, H, W) to tokens (N, 1 + hw, 384), the class token first, and the last attention of the class token
    (N, 6, 1 + hw). H and W: multiples of 16."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, DIM))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + _TRAINED_GRID**2, DIM))
        self.patch_embed = _PatchEmbedding()
        self.blocks = nn.ModuleList(_Block() for _ in range(DEPTH))
        self.norm = nn.LayerNorm(DIM, eps=EPS)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        h, w = x.shape[2] // PATCH, x.shape[3] // PATCH
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), self.patch_embed(x)], dim=1)
        x = x + self._positions(h, w)
        attention = x.new_zeros(0)
        for block in self.blocks:
            x, attention = block(x)
        return self.norm(x), attention[:, :, 0]

    def _positions(self, h: int, w: int) -> Tensor:
        if h == w == _TRAINED_GRID:
            return self.pos_embed
        grid = self.pos_embed[:, 1:].transpose(1, 2).unflatten(2, (_TRAINED_GRID, _TRAINED_GRID))
        # by factors that are a little too large, as in the official code: it moves the samples
        factors = ((h + 0.1) / _TRAINED_GRID, (w + 0.1) / _TRAINED_GRID)
        grid = F.interpolate(grid, scale_factor=factors, mode="bicubic", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], grid.flatten(2).transpose(1, 2)], dim=1)


class _AttentionGate(nn.Module):
    """Features gated by a map made from themselves and the class token's attention heads."""

    def __init__(self) -> None:
        super().__init__()
        self.conv_l = nn.Sequential(nn.Conv2d(DIM + HEADS, DIM, 3, padding=1), nn.BatchNorm2d(DIM))
        self.conv_r = nn.Sequential(nn.Conv2d(DIM, DIM, 3, padding=1), nn.BatchNorm2d(DIM))
        self.act = nn.SiLU()
        self.proj = nn.Conv2d(DIM, 256, 1)

    def forward(self, features: Tensor, attention: Tensor) -> Tensor:
        left = self.act(self.conv_l(torch.cat([features, attention], dim=1)))
        right = self.act(self.conv_r(features * attention.mean(dim=1, keepdim=True)))
        y: Tensor = self.proj(left * right)
        return y


class DinoDecoder(nn.Module):
    """Tokens and class attention to a map (N, 64, h, w) at 1/8 of the full image, whose half the backbone saw."""

    def __init__(self) -> None:
        super().__init__()
        self.attn = _AttentionGate()
        self.decoder = nn.Sequential(
            nn.ConvTranspose2d(256, 128, 4, 2, 1),
            nn.BatchNorm2d(128),
            nn.GELU(),
            nn.ConvTranspose2d(128, 64, 4, 2, 1),
            nn.BatchNorm2d(64),
            nn.GELU(),
        )

    def forward(self, tokens: Tensor, attention: Tensor, size: tuple[int, int]) -> Tensor:
        features = tokens[:, 1:].transpose(1, 2).unflatten(2, size)
        y: Tensor = self.decoder(self.attn(features, attention[:, :, 1:].unflatten(2, size)))
        return y
