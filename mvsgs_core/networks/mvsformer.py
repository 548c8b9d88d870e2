"""MVSFormer (Cao et al. 2022): multi-view stereo by a cascade of cost volumes over transformer features.

Four stages at 1/8, 1/4, 1/2 and full size with 32, 16, 8 and 4 hypotheses in inverse depth. Keys and shapes are
those of the official checkpoints, with the Twins backbone ("twins") or the frozen DINO one ("dino", "-P").
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from mvsgs_core.networks.dino import PATCH, DinoDecoder, DinoSmall
from mvsgs_core.networks.droid import normalize_images
from mvsgs_core.networks.mvsformer_features import PyramidDecoder, PyramidEncoder
from mvsgs_core.networks.mvsformer_stage import Stage, StageOutput
from mvsgs_core.networks.posed_views import check_range, projections
from mvsgs_core.networks.twins import TwinsDecoder, TwinsSmall

HYPOTHESES = (32, 16, 8, 4)
INTERVAL_RATIOS = (2.67, 1.5, 1.0)  # of stages 2 to 4, half width of the range in steps of the stage before
TEMPERATURES = (5.0, 5.0, 5.0, 1.0)
MULTIPLE = 64  # sizes of images that both backbones and the pyramid divide without rest
_FARTHEST = 1e-4  # inverse depths stay above this fraction of the nearest: the cascade itself has no such guard


class MvsOutput(NamedTuple):
    depth: Tensor  # (H, W)
    confidence: Tensor  # (H, W) mean over the stages
    stages: list[StageOutput]


class MvsFormer(nn.Module):
    def __init__(self, backbone: str = "twins") -> None:
        """Raises ValueError for a backbone other than "twins" or "dino"."""
        super().__init__()
        if backbone not in ("twins", "dino"):
            raise ValueError(f"backbone={backbone!r}: it is twins or dino")
        self.encoder, self.decoder = PyramidEncoder(), PyramidDecoder()
        self.vit: nn.Module = TwinsSmall() if backbone == "twins" else DinoSmall()
        self.decoder_vit: nn.Module = TwinsDecoder() if backbone == "twins" else DinoDecoder()
        self.fusions = nn.ModuleList(Stage(d) for d in HYPOTHESES)

    def features(self, images_rgb: Tensor) -> list[Tensor]:
        """(V, 3, H, W) RGB in 0..255 to features (V, 64, 32, 16, 8; h, w) at 1/8, 1/4, 1/2, 1.

        Raises ValueError where H or W is no multiple of 64.
        """
        if images_rgb.shape[2] % MULTIPLE or images_rgb.shape[3] % MULTIPLE:
            raise ValueError(
                f"MVSFormer needs sizes that are multiples of {MULTIPLE}, got {tuple(images_rgb.shape[2:])}"
            )
        images = normalize_images(images_rgb)
        maps = self.encoder(images)
        half = F.interpolate(images, scale_factor=0.5, mode="bicubic", align_corners=False)
        maps[3] = maps[3] + self._transformer(half)
        levels: list[Tensor] = self.decoder(maps)
        return levels

    def _transformer(self, half: Tensor) -> Tensor:
        if isinstance(self.vit, TwinsSmall):
            joined: Tensor = self.decoder_vit(self.vit(half))
            return joined
        tokens, attention = self.vit(half)
        joined = self.decoder_vit(tokens, attention, (half.shape[2] // PATCH, half.shape[3] // PATCH))
        return joined

    @torch.no_grad()
    def forward(
        self,
        images_rgb: Tensor,
        cam_from_world: Tensor,
        cameras: Tensor,
        depth_range: tuple[float, float],
        temperatures: tuple[float, ...] = TEMPERATURES,
    ) -> MvsOutput:
        """Depth of the first of V views.

        images_rgb (V, 3, H, W) in 0..255; cam_from_world (V, 4, 4) and cameras (V, 3, 3) float64 at full size;
        depth_range (near, far), which matters much (MVSFormer's known weakness). Raises ValueError for a bad range.
        """
        near, far = check_range(depth_range)
        features = self.features(images_rgb)
        outputs: list[StageOutput] = []
        for k, stage in enumerate(self.fusions):
            h, w = features[k].shape[2:]
            if k == 0:
                hypotheses = _uniform(near, far, h, w, features[0])
            else:
                hypotheses = narrow(outputs[-1], INTERVAL_RATIOS[k - 1], HYPOTHESES[k], near)
            outputs.append(
                stage(features[k], projections(cam_from_world, cameras, 0.5 ** (3 - k)), hypotheses, temperatures[k])
            )
        size = features[-1].shape[2:]
        confidences = [F.interpolate(o.confidence[None, None], size=size, mode="nearest")[0, 0] for o in outputs]
        return MvsOutput(outputs[-1].depth, torch.stack(confidences).mean(dim=0), outputs)


def _uniform(near: float, far: float, h: int, w: int, like: Tensor) -> Tensor:
    """(32, h, w) depths, uniform in inverse depth, far first."""
    inverse = torch.linspace(1 / far, 1 / near, HYPOTHESES[0], dtype=like.dtype, device=like.device)
    return (1 / inverse)[:, None, None].expand(-1, h, w)


def narrow(previous: StageOutput, ratio: float, count: int, near: float) -> Tensor:
    """(count, 2h, 2w) depths around the previous stage's, far first, uniform in inverse depth."""
    step = 1 / previous.hypotheses[2] - 1 / previous.hypotheses[1]
    center = 1 / previous.depth
    ends = torch.stack([center - ratio * step, center + ratio * step])
    t = torch.linspace(0, 1, count, dtype=step.dtype, device=step.device)[:, None, None]
    inverse = ends[0] + (ends[1] - ends[0]) * t
    inverse = F.interpolate(inverse[None], scale_factor=2, mode="bilinear", align_corners=True)[0]
    return 1 / inverse.clamp(min=_FARTHEST / near)
