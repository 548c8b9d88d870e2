"""Twins-SVT small (Chu et al. 2021): attention within windows, then attention to a pooled map, with a position CNN.

The variant that MVSFormer trains: it returns four levels, each normalized by a layer norm of its own.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

DIMS, HEADS, DEPTHS, POOLING, WINDOW = (64, 128, 256, 512), (2, 4, 8, 16), (2, 2, 10, 4), (8, 4, 2, 1), 7
_BLOCK_EPS = 1e-6  # of blocks and levels; patch embedding and pooling keep torch's 1e-5


class Mlp(nn.Module):
    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return y


class _WindowAttention(nn.Module):
    """Attention within windows of 7x7; padded places neither attend to real ones nor are attended to."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, x: Tensor, h: int, w: int) -> Tensor:
        b, _, c = x.shape
        pad_h, pad_w = -h % WINDOW, -w % WINDOW
        x = F.pad(x.view(b, h, w, c), (0, 0, 0, pad_w, 0, pad_h))
        rows, columns = x.shape[1] // WINDOW, x.shape[2] // WINDOW
        padded = x.new_zeros(1, *x.shape[1:3])
        # `-0:` is the whole axis: where one axis needs no padding nothing is masked, as the released weights expect
        padded[:, -pad_h:], padded[:, :, -pad_w:] = 1.0, 1.0
        x = x.view(b, rows, WINDOW, columns, WINDOW, c).transpose(2, 3).reshape(b, rows * columns, WINDOW**2, c)
        padded = padded.view(1, rows, WINDOW, columns, WINDOW).transpose(2, 3).reshape(1, rows * columns, WINDOW**2)
        mask = -1000.0 * (padded[:, :, None] != padded[:, :, :, None]).to(x)
        q, k, v = self.qkv(x).view(b, rows * columns, WINDOW**2, 3, self.heads, -1).permute(3, 0, 1, 4, 2, 5)
        attention = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5 + mask[:, :, None]).softmax(dim=-1)
        x = (attention @ v).transpose(2, 3).reshape(b, rows, columns, WINDOW, WINDOW, c).transpose(2, 3)
        x = x.reshape(b, rows * WINDOW, columns * WINDOW, c)[:, :h, :w].reshape(b, h * w, c)
        y: Tensor = self.proj(x)
        return y


class _PooledAttention(nn.Module):
    """Attention of every place to the map pooled by `pooling`."""

    def __init__(self, dim: int, heads: int, pooling: int) -> None:
        super().__init__()
        self.heads = heads
        self.q, self.kv, self.proj = nn.Linear(dim, dim), nn.Linear(dim, 2 * dim), nn.Linear(dim, dim)
        self.sr = nn.Conv2d(dim, dim, pooling, pooling) if pooling > 1 else None
        if pooling > 1:
            self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor, h: int, w: int) -> Tensor:
        b, n, c = x.shape
        q = self.q(x).view(b, n, self.heads, -1).transpose(1, 2)
        if self.sr is not None:
            x = self.norm(self.sr(x.transpose(1, 2).view(b, c, h, w)).flatten(2).transpose(1, 2))
        k, v = self.kv(x).view(b, -1, 2, self.heads, c // self.heads).permute(2, 0, 3, 1, 4)
        attention = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).softmax(dim=-1)
        y: Tensor = self.proj((attention @ v).transpose(1, 2).reshape(b, n, c))
        return y


class _Block(nn.Module):
    def __init__(self, dim: int, attention: nn.Module) -> None:
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(dim, eps=_BLOCK_EPS), attention
        self.norm2, self.mlp = nn.LayerNorm(dim, eps=_BLOCK_EPS), Mlp(dim, 4 * dim)

    def forward(self, x: Tensor, h: int, w: int) -> Tensor:
        x = x + self.attn(self.norm1(x), h, w)
        return x + self.mlp(self.norm2(x))


class _PatchEmbedding(nn.Module):
    def __init__(self, inputs: int, dim: int, patch: int) -> None:
        super().__init__()
        self.proj, self.norm = nn.Conv2d(inputs, dim, patch, patch), nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> tuple[Tensor, int, int]:
        x = self.proj(x)
        return self.norm(x.flatten(2).transpose(1, 2)), x.shape[2], x.shape[3]


class _PositionCnn(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Sequential(nn.Conv2d(dim, dim, 3, padding=1, groups=dim))

    def forward(self, x: Tensor, h: int, w: int) -> Tensor:
        b, n, c = x.shape
        y: Tensor = self.proj(x.transpose(1, 2).view(b, c, h, w)).view(b, c, n).transpose(1, 2)
        return x + y


class TwinsSmall(nn.Module):
    """(N, 3, H, W) to four maps (N, dim, H/s, W/s) at s = 4, 8, 16, 32. H and W: multiples of 32."""

    def __init__(self) -> None:
        super().__init__()
        self.patch_embeds = nn.ModuleList()
        self.blocks = nn.ModuleList()
        inputs = 3
        for stage, dim in enumerate(DIMS):
            self.patch_embeds.append(_PatchEmbedding(inputs, dim, 4 if stage == 0 else 2))
            attentions = [
                _WindowAttention(dim, HEADS[stage])
                if k % 2 == 0
                else _PooledAttention(dim, HEADS[stage], POOLING[stage])
                for k in range(DEPTHS[stage])
            ]
            self.blocks.append(nn.ModuleList(_Block(dim, attention) for attention in attentions))
            inputs = dim
        self.pos_block = nn.ModuleList(_PositionCnn(dim) for dim in DIMS)
        self.norm_list = nn.ModuleList(nn.LayerNorm(dim, eps=_BLOCK_EPS) for dim in DIMS)
        self.norm = nn.LayerNorm(DIMS[-1], eps=_BLOCK_EPS)  # in the checkpoints, not part of the computation
        self.head = nn.Linear(DIMS[-1], 1000)  # likewise

    def forward(self, x: Tensor) -> list[Tensor]:
        levels = []
        for embed, blocks, position, norm in zip(self.patch_embeds, self.blocks, self.pos_block, self.norm_list):
            x, h, w = embed(x)
            assert isinstance(blocks, nn.ModuleList)
            for k, block in enumerate(blocks):
                x = block(x, h, w)
                if k == 0:
                    x = position(x, h, w)
            x = norm(x).transpose(1, 2).unflatten(2, (h, w))
            levels.append(x)
        return levels


class TwinsDecoder(nn.Module):
    """The four levels of Twins to one map (N, 64, H/8, W/8) of the full image, whose half the backbone saw."""

    def __init__(self) -> None:
        super().__init__()
        self.upsampler0 = nn.Sequential(nn.ConvTranspose2d(512, 256, 4, 2, 1), nn.BatchNorm2d(256), nn.GELU())
        self.inner1, self.inner2, self.inner3 = nn.Conv2d(256, 256, 1), nn.Conv2d(128, 128, 1), nn.Conv2d(64, 64, 1)
        self.smooth1 = nn.Sequential(nn.Conv2d(256, 128, 3, padding=1), nn.BatchNorm2d(128), nn.ReLU())
        self.smooth2 = nn.Sequential(nn.Conv2d(128, 64, 3, padding=1), nn.BatchNorm2d(64), nn.ReLU())
        self.smooth3 = nn.Sequential(nn.Conv2d(64, 64, 3, padding=1), nn.BatchNorm2d(64), nn.SiLU())

    def forward(self, levels: list[Tensor]) -> Tensor:
        x = self.upsampler0(levels[3])
        x = self.smooth1(x + self.inner1(levels[2]))
        x = self.smooth2(_double(x) + self.inner2(levels[1]))
        y: Tensor = self.smooth3(_double(x) + self.inner3(levels[0]))
        return y


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
