from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core import camera, geometry
from mvsgs_core.datasets import Item, open_dataset
from mvsgs_core.networks import checkpoints
from mvsgs_core.networks.raft_small import RaftSmall
from tests.support.shared_data import shared


@pytest.fixture(scope="module")
def net() -> RaftSmall:
    file = shared("weights/raft-small.pth")
    net = RaftSmall()
    checkpoints.load(net, checkpoints.read(file), file)
    return net


def _image(item: Item) -> torch.Tensor:
    return torch.from_numpy(item.image.copy()).permute(2, 0, 1)[None].float()


def _true_flow(a: Item, b: Item) -> tuple[np.ndarray, np.ndarray]:
    """Flow (2, H, W) of a static scene from depth and poses, and where it is known."""
    assert a.depth is not None
    assert a.world_from_cam is not None
    assert b.world_from_cam is not None
    move = geometry.inverse(b.world_from_cam) @ a.world_from_cam
    points = camera.unproject(a.depth, a.intrinsics) @ move[:3, :3].T + move[:3, 3]
    target = camera.project(points, b.intrinsics)
    u, v = camera.pixel_grid(*a.depth.shape)
    h, w = a.depth.shape
    inside = (target[..., 0] >= 0) & (target[..., 0] < w) & (target[..., 1] >= 0) & (target[..., 1] < h)
    return np.stack([target[..., 0] - u, target[..., 1] - v]), inside & (a.depth > 0)


def test_the_published_weights_find_the_flow(net: RaftSmall) -> None:
    assert sum(p.numel() for p in net.parameters()) == 990_162
    frames = list(open_dataset("replica", path=shared("data/replica/room0_20f"), size=(168, 296), stop=9))
    a, b = frames[0], frames[8]
    truth, known = _true_flow(a, b)
    flow = net(_image(a), _image(b))[0].numpy()
    assert flow.shape == truth.shape
    error = np.linalg.norm(flow - truth, axis=0)[known]
    assert np.linalg.norm(truth, axis=0)[known].mean() > 5
    assert np.median(error) < 0.6  # pixels; without the right lookup order it is several


def test_an_image_onto_itself_does_not_move(net: RaftSmall) -> None:
    image = 255 * torch.rand(1, 3, 72, 101, generator=torch.Generator().manual_seed(0))  # no multiples of 8
    flow = net(image, image, iterations=4)
    assert flow.shape == (1, 2, 72, 101)
    assert flow.abs().median() < 0.3
