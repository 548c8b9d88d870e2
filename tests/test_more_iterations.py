"""More iterations over a finished map, from a program."""

from __future__ import annotations

import pytest

from mvsgs import Mapping
from mvsgs_core.image_metrics import psnr
from tests.support.sequences import synthetic

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("loss", ["ssim", "ges"])
def test_iteration_by_iteration_a_finished_map_gets_no_worse(loss: str) -> None:
    items = synthetic(frames=16, size=(48, 64))
    small = ["mapper.iterations=20", "mapper.refinement=60", "device=cpu", "mapper.threads=1"]
    with Mapping(*small, f"mapper.training.loss={loss}", poses=True, intrinsics=items[0].intrinsics) as mapping:
        for item in items:
            mapping.add(item.image, item.timestamp, pose=item.world_from_cam)
    mapper = mapping._atlas.current

    def shown() -> float:
        renders = [mapping.render(view.world_from_cam).image for view in mapper.views]
        found = [psnr(image / 255.0, items[view.index].image / 255.0) for image, view in zip(renders, mapper.views)]
        return sum(found) / len(found)

    splats, before, rates = len(mapping.map), shown(), []
    for _ in range(40):
        mapping.refine(1)
        rates.append(mapper.trainer.rate)
    assert len(mapping.map) == splats
    assert max(rates) <= 0.2
    assert shown() > before - 0.1
    mapper.trainer.rate = 1.0  # as of a map that was never refined
    mapping.refine(4)
    assert mapper.trainer.rate == 0.1, "as a map is handed out"
    mapping.refine(7)
    assert mapper.trainer.rate == 0.1
    assert len(mapping.map) == splats
