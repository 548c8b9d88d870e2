from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.networks.correlation import CorrelationVolume, OnTheFlyCorrelation
from mvsgs_core.networks.droid import DroidNet, upsample
from tests.support.golden import error, folder, rule_weights

TOLERANCE = 2e-5


@pytest.fixture(scope="module")
def net() -> DroidNet:
    net = DroidNet().eval().requires_grad_(False)
    net.load_state_dict(rule_weights(folder("droid") / "state_dict.json"), strict=True)
    return net


def _stored(name: str) -> dict[str, np.ndarray]:
    return dict(np.load(folder("droid") / f"{name}.npz"))


def _images(stored: dict[str, np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(stored["images_bgr"][:, ::-1].copy()).float()


def test_encoders(net: DroidNet) -> None:
    stored = _stored("encoders")
    images = _images(stored)
    hidden, context = net.context(images)
    assert error(net.features(images), stored["fmap"]) < TOLERANCE
    assert error(hidden, stored["net"]) < TOLERANCE
    assert error(context, stored["inp"]) < TOLERANCE


def test_both_correlations(net: DroidNet) -> None:
    stored = _stored("corr")
    features = torch.from_numpy(_stored("encoders")["fmap"])
    source, target = features[stored["ii"]], features[stored["jj"]]
    coords = torch.from_numpy(stored["coords"])
    volume = CorrelationVolume(source, target)
    assert error(volume(coords), stored["corr"]) < TOLERANCE
    assert error(OnTheFlyCorrelation(source, target)(coords), stored["corr"]) < TOLERANCE
    h, w = source.shape[2:]
    for level in range(4):
        seen = volume.pyramid[level].reshape(-1, h, w, *volume.pyramid[level].shape[2:])[0, 5, 7]
        assert error(seen, stored[f"pyr{level}_edge0_y5x7"]) < TOLERANCE


def test_a_correlation_in_half_precision_is_finite_where_its_value_is() -> None:
    """The product of these features is 115,200, and a half float goes to 65,504."""
    features = torch.full((1, 128, 8, 8), 30.0)
    with torch.autocast("cpu", dtype=torch.float16):
        volume = CorrelationVolume(features, features)
    assert volume.pyramid[0].dtype == torch.float16
    assert (volume.pyramid[0] == 7200.0).all()


def test_update_operator(net: DroidNet) -> None:
    stored = {k: torch.from_numpy(v) for k, v in _stored("update").items()}
    out = net.update(stored["net"], stored["inp"], stored["corr"], stored["motion"], stored["ii"])
    for name, value in out._asdict().items():
        assert error(value, stored[f"out_{name}"].numpy()) < TOLERANCE, name


def test_update_operator_of_the_motion_filter(net: DroidNet) -> None:
    stored = {k: torch.from_numpy(v) for k, v in _stored("update").items()}
    out = net.update(stored["net"][:1], stored["inp"][:1], stored["corr"][:1])
    assert out.eta is None
    names = [n for n in ("net", "delta", "weight") if f"single_{n}" in stored]
    assert len(names) >= 2
    for name in names:
        assert error(getattr(out, name), stored[f"single_{name}"].numpy().reshape(getattr(out, name).shape)) < TOLERANCE


def test_convex_upsampling() -> None:
    stored = _stored("upsample")
    mask = torch.from_numpy(_stored("update")["out_upmask"])
    assert error(upsample(torch.from_numpy(stored["disp"]), mask), stored["disp_up"]) < TOLERANCE
