from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.networks.vfuse import Fused, FusionInput, VFuse, narrowness, splat_views
from tests.support.golden import error, folder, rule_weights


@pytest.fixture(scope="module")
def net() -> VFuse:
    net = VFuse().eval()
    net.load_state_dict(rule_weights(folder("vfuse") / "state_dict.json"), strict=True)
    return net


@pytest.fixture(scope="module")
def stored() -> dict[str, np.ndarray]:
    return dict(np.load(folder("vfuse") / "vfuse.npz"))


@pytest.fixture(scope="module")
def views(stored: dict[str, np.ndarray]) -> FusionInput:
    cams = torch.from_numpy(stored["cams"]).double()
    depths, confidences = torch.from_numpy(stored["depths"]), torch.from_numpy(stored["confs"])
    return FusionInput(depths, confidences, cams[:, 0], cams[:, 1, :3, :3], near=2.0, far=8.0)


def _fuse(net: VFuse, views: FusionInput, stored: dict[str, np.ndarray], center: str = "conf") -> Fused:
    warped = torch.from_numpy(stored["warped_depths"]), torch.from_numpy(stored["warped_confs"])
    fused: Fused = net(views, center, warped)
    return fused


def test_splatting(views: FusionInput, stored: dict[str, np.ndarray]) -> None:
    depths, confidences = splat_views(views)
    settled = stored["warp_unsettled"] == 0
    assert settled.mean() > 0.9
    for ours, theirs in ((depths, stored["warped_depths"]), (confidences, stored["warped_confs"])):
        assert np.abs(ours.numpy() - theirs)[settled].max() / theirs.max() < 2e-5


@pytest.mark.parametrize("center", ["conf", "mean"])
def test_search_window(net: VFuse, views: FusionInput, stored: dict[str, np.ndarray], center: str) -> None:
    fused = _fuse(net, views, stored, center)
    if center == "conf":
        assert error(fused.statistics, stored["swenet_input"]) < 2e-5
    assert error(fused.window, stored[f"{center}_window"]) < 2e-5
    assert error(fused.bounds, stored[f"{center}_depth_bounds"]) < 2e-5


def test_visibility_volume(net: VFuse, views: FusionInput, stored: dict[str, np.ndarray]) -> None:
    volume = _fuse(net, views, stored).volume.numpy()
    compared = stored["volume_denormal_dependent"] == 0
    assert np.abs(volume - stored["volume"])[compared].max() / stored["volume"].max() < 5e-4


def test_regularization(net: VFuse, stored: dict[str, np.ndarray]) -> None:
    with torch.no_grad():
        logits = net._regularize(torch.from_numpy(stored["volume"]))
    assert error(logits, stored["logits"]) < 2e-5
    assert error(logits.softmax(dim=0), stored["prob_volume"]) < 2e-5


@pytest.mark.parametrize("center", ["conf", "mean"])
def test_fused_depth(net: VFuse, views: FusionInput, stored: dict[str, np.ndarray], center: str) -> None:
    fused = _fuse(net, views, stored, center)
    difference = np.abs(fused.depth.numpy() - stored[f"{center}_fused_depth"]) / stored[f"{center}_fused_depth"].max()
    assert (difference < 1e-4).mean() > 0.98
    assert difference.max() < 1e-3
    assert error(fused.confidence, stored[f"{center}_fused_conf"]) < 2e-5


def test_the_confidence_is_1_in_the_narrowest_window_and_where_all_are_alike() -> None:
    np.testing.assert_allclose(narrowness(torch.tensor([[1.0, 3.0, 2.0]])), [[1.0, 0.0, 0.5]])
    np.testing.assert_allclose(narrowness(torch.ones(1, 5)), np.ones((1, 5)))


def test_an_unknown_center_is_refused(net: VFuse, views: FusionInput) -> None:
    with pytest.raises(ValueError, match="conf or mean"):
        net(views, center="median")


def test_holes_and_odd_sizes(net: VFuse, views: FusionInput) -> None:
    depths = views.depths.clone()
    depths[:, :16] = 0  # nothing is known in the upper rows of any view
    fused = net(FusionInput(depths, views.confidences, views.cam_from_world, views.cameras, 2.0, 8.0))
    assert torch.isfinite(fused.depth).all()
    empty = splat_views(FusionInput(depths, views.confidences, views.cam_from_world, views.cameras, 2.0, 8.0))[0]
    assert (fused.depth[(empty == 0).all(dim=0)] == 0).all()
    cut = views.depths[:, :60], views.confidences[:, :60]
    with pytest.raises(ValueError, match="multiples of 8"):
        net(FusionInput(*cut, views.cam_from_world, views.cameras, 2.0, 8.0))
