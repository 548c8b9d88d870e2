"""One training iteration: what it refuses is counted once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import trainer
from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.map_state import MapState
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
    state = MapState(1, torch.device("cpu"))
    state.append(random_splats(50, bases=1), torch.zeros(50, dtype=torch.int64))
    image = np.full((*SIZE, 3), 128, dtype=np.uint8)
    depth = np.ones(SIZE, dtype=np.float32)
    view = training_view(RGBDKeyframe(0, image, intrinsics(SIZE), np.eye(4), depth), np.eye(4), None, state.device)
    log = Stats()
    trainer.Trainer(MapperConfig(threads=1), state, log).step(view, 1.0)
    refused = {name: count for name, count in log.counts.items() if name.startswith("refused")}
    assert refused == {"refused_gradients": 3}
