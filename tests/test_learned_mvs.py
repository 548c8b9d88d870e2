"""Published stereo networks as nodes: real weights where they are, random ones for the path, clear errors without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from launch.compose import compose
from msgs import Depth, Keyframe
from mvsgs_core import camera
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.mvs.learned import NETWORKS, calibrated
from mvsgs_core.networks.itermvs import IterMvs
from nodes.learned_mvs import LearnedMvs
from tests.support.shared_data import shared


def _keyframe(item: Item) -> Keyframe:
    """A keyframe with true poses and a coarse grid of true depth, as a good tracker would send."""
    assert item.depth is not None
    assert item.world_from_cam is not None
    grid = item.depth[4::8, 4::8]
    known = grid > 0
    inverse = np.where(known, 1 / np.where(known, grid, 1), 0).astype(np.float32)
    return Keyframe(
        item.index, item.timestamp, item.image, item.intrinsics, item.world_from_cam, 1.0, inverse,
        known.astype(np.float32), 0,
    )  # fmt: skip


def _depths(config: LearnedMvs.Config, keyframes: list[Keyframe]) -> list[Depth]:
    node = LearnedMvs(config)
    return [d for k in keyframes for d in node.on_keyframe(k)] + list(node.on_end())


@pytest.mark.slow
def test_itermvs_with_published_weights_finds_the_room() -> None:
    weights = str(shared("weights/itermvs_blendedmvs.ckpt"))
    frames = list(open_dataset("synthetic", frames=25, stride=6))
    config = LearnedMvs.Config(weights=weights, network_area=320 * 256, area=160 * 120, device="cpu")
    depths = _depths(config, [_keyframe(f) for f in frames])
    assert [d.index for d in depths] == [f.index for f in frames]
    found, frame = depths[2], frames[2]
    assert frame.depth is not None
    truth = frame.depth[
        :: frame.depth.shape[0] // found.depth.shape[0], :: frame.depth.shape[1] // found.depth.shape[1]
    ]
    error = np.abs(found.depth - truth) / truth
    assert np.median(error) < 0.06
    # the confidence is a probability: as many depths are within 5 % as it says (calibrated on other frames)
    assert abs(found.confidence.mean() - (error < 0.05).mean()) < 0.12
    assert (error < 0.05)[found.confidence > 0.8].mean() > 0.85


def test_a_calibration_keeps_the_order_and_the_range() -> None:
    confidence = np.linspace(0, 1, 101, dtype=np.float32)
    ours = calibrated(confidence, (2.69, 1.27))
    assert (np.diff(ours[1:-1]) > 0).all()
    assert 0 <= ours.min() < ours.max() <= 1
    np.testing.assert_array_equal(calibrated(confidence, None), confidence)
    np.testing.assert_allclose(calibrated(confidence, (0.0, 1.0))[1:-1], confidence[1:-1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["mvsformer", "mvsformer_p"])
def test_the_papers_network_runs_untrained_and_says_so(network: str) -> None:
    frames = list(open_dataset("synthetic", frames=13, stride=6, size=(120, 160)))
    config = LearnedMvs.Config(network=network, weights="random", network_area=128 * 128, area=80 * 60, device="cpu")
    node = LearnedMvs(config)
    assert any("its depth is noise" in w for w in node.stats.warnings)
    depths = [d for f in frames for d in node.on_keyframe(_keyframe(f))] + list(node.on_end())
    assert len(depths) == len(frames)
    assert all(np.isfinite(d.depth).all() and (d.confidence >= 0).all() for d in depths)


def test_keyframes_of_photographs_come_in_any_order() -> None:
    config = LearnedMvs.Config(
        weights="random", network_area=64 * 64, area=48 * 64, device="cpu", threads=1, window=2, lag=1
    )
    frames = list(open_dataset("synthetic", frames=8, size=(48, 64)))[::-1]
    found = _depths(config, [_keyframe(frame) for frame in frames])
    assert [depth.index for depth in found] == [frame.index for frame in frames]


def test_keyframes_of_images_of_several_sizes_are_neighbors() -> None:
    """Of one size in the cascade's eyes, of another in the network's, which enlarges none."""
    config = LearnedMvs.Config(weights="random", network_area=128 * 160, area=48 * 64, device="cpu", threads=1)
    sizes = ((96, 128), (192, 256))
    frames = [list(open_dataset("synthetic", frames=6, size=size)) for size in sizes]
    found = _depths(config, [_keyframe(frames[n % 2][n]) for n in range(6)])
    assert [depth.depth.shape for depth in found] == [(48, 64)] * 6
    assert all((depth.depth > 0).any() for depth in found)


def test_what_a_network_gives_that_is_not_finite_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    config = LearnedMvs.Config(weights="random", network_area=64 * 64, area=64 * 64, device="cpu", threads=1)
    whole = IterMvs.forward

    def holed(net: IterMvs, *given: Any) -> Any:
        found = whole(net, *given)
        found.depth[:8, :4], found.confidence[-1, -2:] = torch.nan, torch.nan
        return found

    monkeypatch.setattr(IterMvs, "forward", holed)
    node = LearnedMvs(config)
    frames = list(open_dataset("synthetic", frames=3, size=(64, 64)))
    depths = [d for f in frames for d in node.on_keyframe(_keyframe(f))] + list(node.on_end())
    assert node.stats.counts["refused_pixels"] == 3 * (8 * 4 + 2)
    assert any("no finite depth or confidence" in warning for warning in node.stats.warnings)
    assert all(not d.depth[:8, :4].any() and np.isfinite(d.confidence).all() for d in depths)


@pytest.mark.parametrize("network", ["mvsformer", "mvsformer_p"])
def test_the_papers_depth_is_handed_on_as_large_as_the_network_gives_it(network: str) -> None:
    config = compose([f"mvs={network}", "mvs.weights=random", "dataset=synthetic"]).slots["mvs"].parameters
    assert config.area == config.network_area
    for image in ((480, 640), (680, 1200), (720, 1280)):
        height, width = camera.fit_size(*image, config.area)
        assert height % 8 == width % 8 == 0  # as V-FUSE needs them
        seen = camera.fit_size(*image, config.network_area, NETWORKS[network].multiple)
        assert height * width > 0.9 * seen[0] * seen[1]


def test_missing_weights_say_what_to_fetch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"no weights of MVSFormer.*OneDrive.*set MVSGS_WEIGHTS"):
        LearnedMvs(LearnedMvs.Config(network="mvsformer"))
    with pytest.raises(FileNotFoundError, match="there is no file"):
        LearnedMvs(LearnedMvs.Config(network="itermvs", weights=str(tmp_path / "nothing.pth")))
    with pytest.raises(ValueError, match=r"no network 'x'; there are: mvsformer"):
        LearnedMvs(LearnedMvs.Config(network="x"))
