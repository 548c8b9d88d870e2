"""V-FUSE as a node: untrained it runs and says so; without weights it says what to fetch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import Depth
from mvsgs_core.datasets import open_dataset
from mvsgs_core.networks.vfuse import VFuse
from nodes.learned_fusion import LearnedFusion

pytestmark = pytest.mark.slow

RANDOM: dict[str, Any] = {"weights": "random", "confidence": 0.0, "relative": 0.05, "device": "cpu"}


def _depths(scale: float) -> list[Depth]:
    frames = open_dataset("synthetic", frames=25, stride=6, size=(120, 160), scale=scale)
    depths = []
    for f in frames:
        assert f.depth is not None
        assert f.world_from_cam is not None
        pose, confidence = f.world_from_cam, np.full(f.depth.shape, 0.9, np.float32)
        confidence[:, ::3] = 0.6
        depths.append(Depth(f.index, f.timestamp, f.image, f.intrinsics, pose, 1.0, f.depth, confidence, 0))
    return depths


@pytest.mark.parametrize("center", ["conf", "mean"])
def test_untrained_it_runs_and_says_so(center: str) -> None:
    node = LearnedFusion(LearnedFusion.Config(center=center, **RANDOM))
    depths = _depths(1.0)
    views = [v for d in depths for v in node.on_depth(d)] + list(node.on_end())
    assert [v.index for v in views] == [d.index for d in depths]
    assert any("its refinement is noise" in w for w in node.stats.warnings)
    assert all(np.isfinite(v.depth).all() and np.isfinite(v.confidence).all() for v in views)
    # untrained, the expectation lies near the window's center, which is the true depth here: so much must survive
    kept = views[2].depth > 0
    assert kept.mean() > 0.3
    assert np.median(np.abs(views[2].depth - depths[2].depth)[kept] / depths[2].depth[kept]) < 0.05


def test_pixels_without_a_finite_depth_are_counted_and_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = VFuse.forward

    def broken(net: VFuse, *args: Any, **options: Any) -> Any:
        fused = whole(net, *args, **options)
        fused.depth[:10] = float("nan")
        return fused

    monkeypatch.setattr(VFuse, "forward", broken)
    node = LearnedFusion(LearnedFusion.Config(**RANDOM))
    views = [v for d in _depths(1.0) for v in node.on_depth(d)] + list(node.on_end())
    assert all(np.isfinite(v.depth).all() and not v.depth[:10].any() for v in views)
    assert node.stats.counts["refused_pixels"] == 10 * 160 * len(views)
    assert any("V-FUSE gave no finite depth" in w for w in node.stats.warnings)


def test_the_worlds_scale_does_not_matter() -> None:
    kept = []
    for scale in (1e-3, 1.0):
        node = LearnedFusion(LearnedFusion.Config(**RANDOM))
        views = [v for d in _depths(scale) for v in node.on_depth(d)] + list(node.on_end())
        kept.append(views[2].depth / scale)
    both = (kept[0] > 0) & (kept[1] > 0)
    assert both.mean() > 0.3
    np.testing.assert_allclose(kept[0][both], kept[1][both], rtol=5e-3)


def test_missing_weights_say_what_to_fetch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"no weights of V-FUSE.*SharePoint"):
        LearnedFusion()
