"""A GPU's kernels are compiled before the stream: in it the first keyframe would wait for them, for seconds, and a live
stream would take that for what new splats cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.trainer import Trainer
from mvsgs_core.rasterizer.rasterize import chosen_backend
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.stats import Stats

WIDTHS = (16, 17)  # Triton compiles the loss anew for widths that 16 divides


def warm_up(config: MapperConfig, device: torch.device) -> None:
    """Trains a map of one splat, of this configuration, as the stream will train its own.

    A loss of the user's own is left out, which may do more than that, and a rolling shutter, which is not known of yet.
    Where Triton does not render, nothing is done.
    """
    if chosen_backend(config.training.backend, device) != "triton":
        return
    config = replace(config, training=replace(config.training, loss_function=None))
    for width in WIDTHS:
        image, depth = np.zeros((16, width, 3), np.uint8), np.ones((16, width), np.float32)
        keyframe = RGBDKeyframe(0, image, np.array([16.0, 16.0, 8.0, 8.0]), np.eye(4), depth)
        view = training_view(keyframe, np.eye(4), None, device)
        state = MapState((config.sh_degree + 1) ** 2, device)
        state.append(_splat((config.sh_degree + 1) ** 2), torch.zeros(1, dtype=torch.int64))
        trainer = Trainer(config, state, Stats())
        view.visits = config.training.pose_visits  # from which on its pose may be trained
        for view.fixed in (True, False):
            trainer.step(view, 1.0)
        trainer.weights(view, 1.0)


def _splat(bases: int) -> Splats:
    """One, before the camera."""
    return Splats(
        torch.tensor([[0.0, 0.0, 1.0]]), torch.full((1, 3), -2.0), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.zeros(1),
        torch.zeros(1, bases, 3), torch.zeros(1),
    )  # fmt: skip
