"""One training iteration: what it refuses is counted once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import optimizer, training
from mvsgs_core.mapping.keyframes import RGBDKeyframe, training_view
from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.interface import Backward, Render
from tests.support.rasterizer_scenes import intrinsics, random_splats

SIZE = (40, 56)


class Counts(dict[str, float]):
    def count(self, name: str, n: float = 1) -> None: ...

    def skip(self, what: str, n: float = 1) -> None: ...

    def refuse(self, name: str, n: float, text: str) -> None:
        self[name] = self.get(name, 0) + n


def test_refused_gradients_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rasterize = training.rasterize

    def refusing(*arguments: Any, **options: Any) -> Render:
        render = rasterize(*arguments, **options)
        render.backward = Backward(refused=3)
        return render

    monkeypatch.setattr(training, "rasterize", refusing)
    state = MapState(1, torch.device("cpu"))
    state.append(random_splats(50, bases=1), torch.zeros(50, dtype=torch.int64))
    image = np.full((*SIZE, 3), 128, dtype=np.uint8)
    depth = np.ones(SIZE, dtype=np.float32)
    view = training_view(RGBDKeyframe(0, image, intrinsics(SIZE), np.eye(4), depth), np.eye(4), None, 1, state.device)
    counts = Counts()
    training.train_once(
        state, view, training.TrainingConfig(threads=1), training.SkipConfig(),
        optimizer.groups(optimizer.OptimizerConfig(), 1.0, 1.0, False, "gaussian"), 600, 1.0, 1.0, False, counts,
    )  # fmt: skip
    assert counts == {"gradients": 3}
