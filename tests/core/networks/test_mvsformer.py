from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.networks.mvsformer import MvsFormer, MvsOutput
from mvsgs_core.networks.twins import TwinsSmall
from tests.support.golden import error, folder, rule_weights


def _network(backbone: str) -> MvsFormer:
    net = MvsFormer(backbone).eval()
    net.load_state_dict(rule_weights(folder("mvsformer") / f"{backbone}_state_dict.json"), strict=True)
    return net


def _stored(name: str) -> dict[str, np.ndarray]:
    return dict(np.load(folder("mvsformer") / f"{name}.npz"))


@pytest.fixture(scope="module", params=["twins", "dino"])
def case(request: pytest.FixtureRequest) -> tuple[MvsFormer, MvsOutput, dict[str, np.ndarray]]:
    stored, net = _stored(request.param), _network(request.param)
    images = torch.from_numpy(stored["images_rgb"]).float()
    cameras = torch.from_numpy(stored["intrinsics"]).double().expand(3, 3, 3)
    values = stored["depth_values"]
    output = net(images, torch.from_numpy(stored["extrinsics"]).double(), cameras, (values[0], values[-1]))
    return net, output, stored


@pytest.mark.slow
def test_features(case: tuple[MvsFormer, MvsOutput, dict[str, np.ndarray]]) -> None:
    net, _, stored = case
    images = torch.from_numpy(stored["images_rgb"]).float()
    with torch.no_grad():
        features = net.features(images)
    for k, every in enumerate((1, 1, 8, 8)):
        assert error(features[k][:, :, ::every, ::every], stored[f"features_stage{k + 1}"]) < 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("stage", [1, 2, 3, 4])
def test_stages(case: tuple[MvsFormer, MvsOutput, dict[str, np.ndarray]], stage: int) -> None:
    _, output, stored = case
    ours = output.stages[stage - 1]
    every = 1 if stage < 3 else 4
    assert error(ours.depth, stored[f"depth_stage{stage}"]) < 1e-4
    assert error(ours.confidence, stored[f"conf_stage{stage}"]) < 2e-4
    assert error(ours.logits[:, ::every, ::every], stored[f"logits_stage{stage}"]) < 1e-4
    assert error(ours.view_weight[:, ::every, ::every], stored[f"view_weight_stage{stage}"]) < 2e-4
    if stage > 1:
        assert error(ours.hypotheses[:, ::4, ::4], stored[f"depth_hypotheses_stage{stage}"]) < 1e-4
    else:
        assert error(ours.volume[:, ::4], stored["volume_mean_stage1"]) < 1e-4


@pytest.mark.slow
def test_confidence(case: tuple[MvsFormer, MvsOutput, dict[str, np.ndarray]]) -> None:
    _, output, stored = case
    assert error(output.confidence, stored["confidence"]) < 2e-4


def test_windows_without_padding_on_one_axis() -> None:
    stored = _stored("twins_backbone_32x224")
    net = TwinsSmall().eval()
    state = rule_weights(folder("mvsformer") / "twins_state_dict.json")
    net.load_state_dict({k.removeprefix("vit."): v for k, v in state.items() if k.startswith("vit.")})
    image = torch.from_numpy(stored["image_rgb"]).float()[None]
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    image = (image / 255 - mean[:, None, None]) / deviation[:, None, None]
    with torch.no_grad():
        levels = net(image)
    for k, level in enumerate(levels):
        assert error(level[0], stored[f"level{k + 1}"]) < 2e-5


def test_what_cannot_be_done_is_refused() -> None:
    net = MvsFormer()
    poses, cameras = torch.eye(4).double().expand(2, 4, 4), torch.eye(3).double().expand(2, 3, 3)
    with pytest.raises(ValueError, match="multiples of 64"):
        net(torch.zeros(2, 3, 60, 64), poses, cameras, (1.0, 2.0))
    with pytest.raises(ValueError, match="0 < near < far"):
        net(torch.zeros(2, 3, 64, 64), poses, cameras, (2.0, 1.0))
    with pytest.raises(ValueError, match="twins or dino"):
        MvsFormer("resnet")
