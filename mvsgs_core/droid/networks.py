"""DROID-SLAM's networks where they run: on the CPU in single precision, on a GPU in half precision."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mvsgs_core.droid.config import CorrelationKind
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.checkpoints import RANDOM
from mvsgs_core.networks.correlation import CorrelationVolume, OnTheFlyCorrelation
from mvsgs_core.networks.droid import DroidNet

Correlation = CorrelationVolume | OnTheFlyCorrelation
CORRELATIONS: dict[str, type[CorrelationVolume] | type[OnTheFlyCorrelation]] = {
    "volume": CorrelationVolume,
    "on_the_fly": OnTheFlyCorrelation,
}


def load(file: str | None) -> DroidNet:
    """The network with the weights of a file, of the registry's folders (None), or with random ones ("random").

    Raises FileNotFoundError, saying what to fetch from where, or ValueError for a file that does not fit.
    """
    if file == RANDOM:
        return random_net()
    net = DroidNet()
    checkpoints.load_registered(net, "droid", file, convert=checkpoints.droid_rows)
    return net


def check(file: str | None) -> None:
    """Raises what `load` would, before the network is needed."""
    checkpoints.check(DroidNet, "droid", file, convert=checkpoints.droid_rows)


def random_net(seed: int = 0) -> DroidNet:
    """Weights that keep activations at their size (He et al. 2015), so that every part of the system is exercised."""
    gain_of_revision = 3.0  # of the last layer: revisions of several cells, which pass the motion filter
    generator = torch.Generator().manual_seed(seed)
    net = DroidNet().eval().requires_grad_(False)
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d):
            fan_in = layer.weight[0].numel()
            layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator) * (2.0 / fan_in) ** 0.5)
            assert layer.bias is not None
            layer.bias.zero_()
    revision = net.update.delta[2]
    assert isinstance(revision, nn.Conv2d)
    revision.weight.mul_(gain_of_revision)
    return net


class Revision(NamedTuple):
    """What one update says of E edges; all on the CPU, float32, but for the hidden state."""

    hidden: Tensor  # (E, 128, h, w)
    delta: np.ndarray  # (E, h, w, 2) cells
    weight: np.ndarray  # (E, h, w, 2), 0 to 1
    damping: np.ndarray | None  # (F, h, w), of the distinct sources in ascending order


class Networks:
    def __init__(self, net: DroidNet, device: torch.device) -> None:
        self.device = device
        self.net = net.to(device)
        self.not_finite = 0  # revisions that held a NaN or an infinity and were ignored

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, dtype=torch.float16, enabled=self.device.type == "cuda")

    def _input(self, images: Sequence[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(images)).to(self.device).permute(0, 3, 1, 2).float()

    @torch.no_grad()
    def features(self, images: Sequence[np.ndarray]) -> Tensor:
        """(N, 128, h, w) of N images (8h, 8w, 3) uint8 RGB."""
        with self._precision():
            return self.net.features(self._input(images))

    @torch.no_grad()
    def context(self, image: np.ndarray) -> tuple[Tensor, Tensor]:
        """Initial hidden state and context, both (128, h, w)."""
        with self._precision():
            hidden, context = self.net.context(self._input([image]))
        return hidden[0], context[0]

    @torch.no_grad()
    def correlation(self, source: Tensor, to: Tensor, kind: CorrelationKind) -> Correlation:
        """Of the features (128, h, w) of one edge's two ends."""
        with self._precision():
            return CORRELATIONS[kind](source[None], to[None])

    @torch.no_grad()
    def revise(
        self,
        hidden: Sequence[Tensor],
        context: Sequence[Tensor],
        correlations: Iterable[Correlation],
        coords: np.ndarray,
        motion: np.ndarray | None,
        source: np.ndarray | None,
    ) -> Revision:
        """One update of E edges.

        coords: (E, h, w, 2) where the correlation is looked up; motion: (E, h, w, 4); source: (E,) keyframe of each
        edge, None: no damping is wanted. Correlations are taken one by one. An edge whose revision is not finite keeps
        its state and gets no weight.
        """
        at = torch.from_numpy(coords.astype(np.float32)).to(self.device)
        with self._precision():
            looked_up = torch.cat([c(at[k : k + 1]) for k, c in enumerate(correlations)])
            moved = None
            if motion is not None:
                moved = torch.from_numpy(motion.astype(np.float32)).to(self.device).permute(0, 3, 1, 2)
            before = torch.stack(list(hidden))
            of = None if source is None else torch.from_numpy(source).to(self.device)
            update = self.net.update(before, torch.stack(list(context)), looked_up, moved, of)
        after, delta, weight = update.net, update.delta.float(), update.weight.float()
        good = torch.stack([torch.isfinite(x.flatten(1).float()).all(dim=1) for x in (after, delta, weight)]).all(dim=0)
        if not bool(good.all()):
            self.not_finite += int((~good).sum())
            after = torch.where(good[:, None, None, None], after, before.to(after.dtype))
            delta, weight = (torch.where(good[:, None, None, None], x, torch.zeros_like(x)) for x in (delta, weight))
        damping = None
        if update.eta is not None:
            damping = np.nan_to_num(update.eta.float().cpu().numpy(), nan=1.0, posinf=1.0)
        return Revision(after, delta.cpu().numpy(), weight.cpu().numpy(), damping)


__all__ = ["CORRELATIONS", "RANDOM", "Correlation", "Networks", "Revision", "check", "load", "random_net"]
