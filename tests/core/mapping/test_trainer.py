"""One training iteration: what it refuses is counted once, and how wide splats may grow in it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import trainer
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.mapping.optimizer import OptimizerConfig
from mvsgs_core.rasterizer.interface import Backward, Render
from mvsgs_core.stats import Stats
from tests.support.rasterizer_scenes import intrinsics, random_splats

SIZE = (40, 56)


def test_refused_gradients_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rasterize = trainer.rasterize

    def refusing(*arguments: Any, **options: Any) -> Render:
        render = rasterize(*arguments, **options)
        render.backward = Backward(refused=3)
        return render

    monkeypatch.setattr(trainer, "rasterize", refusing)
    state, view = map_of_50()
    log = Stats()
    trainer.Trainer(MapperConfig(threads=1), state, log).step(view, 1.0)
    refused = {name: count for name, count in log.counts.items() if name.startswith("refused")}
    assert refused == {"refused_gradients": 3}


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("refining", [False, True])
def test_splats_may_grow_wider_in_the_refinement_than_in_the_stream(backend: Any, refining: bool) -> None:
    state, view = map_of_50()
    with torch.no_grad():
        state.splats.log_scales.fill_(math.log(0.2))
    config = MapperConfig(
        training=TrainingConfig(backend=backend), threads=1,
        optimizer=OptimizerConfig(max_scale=0.4, max_scale_in_stream=0.5),
    )  # fmt: skip
    trainer.Trainer(config, state, Stats()).step(view, 1.0, refining=refining)
    widest = float(state.splats.log_scales.detach().exp().max())
    assert widest == pytest.approx(0.2 * (math.exp(config.optimizer.log_scales) if refining else 1.0), rel=1e-3)
    assert state.first["log_scales"].min() < 0.0  # the bound is what held them


def map_of_50() -> tuple[MapState, TrainingView]:
    """Splats, and a gray image of them."""
    state = MapState(1, torch.device("cpu"))
    state.append(random_splats(50, bases=1), torch.zeros(50, dtype=torch.int64))
    image = np.full((*SIZE, 3), 128, dtype=np.uint8)
    depth = np.ones(SIZE, dtype=np.float32)
    view = training_view(RGBDKeyframe(0, image, intrinsics(SIZE), np.eye(4), depth), np.eye(4), None, state.device)
    return state, view
