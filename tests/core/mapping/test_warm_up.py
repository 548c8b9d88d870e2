"""What a stream launches on a GPU was compiled before it."""

from __future__ import annotations

import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.warm_up import warm_up
from nodes.mapper import Mapper
from tests.support.kernel_variants import Variants
from tests.support.rasterizer_scenes import device_of
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

pytestmark = [pytest.mark.slow, pytest.mark.gpu]

pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")

DEVICE = device_of("triton")


def test_a_stream_launches_nothing_that_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    training = TrainingConfig(backend="triton", refine_poses=True, pose_visits=0)
    config = MapperConfig(iterations=1, device=DEVICE, training=training)
    for module in ("photograph_loss", "ssim"):  # the loss too, as on a GPU
        monkeypatch.setattr(f"mvsgs_core.rasterizer.{module}.chosen_backend", lambda image: "triton")
    variants = Variants(monkeypatch)
    warm_up(config, torch.device(DEVICE))
    compiled = variants.found.copy()
    assert len({name for name, *_ in compiled}) == 8
    mapper = OnlineMapper(config)
    for k, size in enumerate([(8, 18), (10, 16)]):
        mapper.add_keyframe(rgbd_keyframe(k, pose_on_arc(0.3 * k), size))
    while mapper.step():
        pass
    mapper.trainer.weights(mapper.views[1], mapper.median_depth)  # as pruning asks for them
    assert len(mapper.state) > 10
    assert mapper.views[1].pose_steps > 0
    assert variants.found <= compiled


def test_where_triton_does_not_render_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    variants = Variants(monkeypatch)
    for backend in ("auto", "cpu", "reference"):
        warm_up(MapperConfig(training=TrainingConfig(backend=backend)), torch.device("cpu"))
    assert not variants.found


def test_a_mapper_begins_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("nodes.mapper.warm_up", lambda *what: given.append(what))
    config = Mapper.Config(device="cpu")
    Mapper(config)
    assert given == [(config, torch.device("cpu"))]
