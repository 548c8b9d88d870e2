"""Every inner layer that the reference outputs describe (golden, *checks.json): the first that differs has a name."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvsgs_core.networks.correlation import CorrelationVolume
from mvsgs_core.networks.droid import DroidNet, normalize_images
from mvsgs_core.networks.mvsformer import MvsFormer
from mvsgs_core.networks.vfuse import FusionInput, VFuse
from tests.support.golden import check_error, checks, error, folder, recorded, rule_weights

LAYERS, VOLUMES, WEIGHTS = 2e-5, 1e-4, 2e-4  # of backbones and features, of cost volumes, of view weights


def test_droid() -> None:
    net = DroidNet().eval().requires_grad_(False)
    net.load_state_dict(rule_weights(folder("droid") / "state_dict.json"), strict=True)
    images_bgr = np.load(folder("droid") / "encoders.npz")["images_bgr"]
    images = torch.from_numpy(images_bgr[:, ::-1].copy()).float()
    state = {k: torch.from_numpy(v) for k, v in np.load(folder("droid") / "update.npz").items()}
    with recorded(net) as ours:
        features = net.features(images)
        net.context(images)
        net.update(state["net"], state["inp"], state["corr"], state["motion"], state["ii"])
    ours |= {"images_normalised": normalize_images(images)}
    ours |= {f"{name}.norm1": ours[f"{name}.norm"] for name in ("fnet", "cnet")}
    edges = np.load(folder("droid") / "corr.npz")
    volume = CorrelationVolume(features[edges["ii"]], features[edges["jj"]])
    ours |= {f"corr_pyramid.{level}": volume.pyramid[level] for level in range(4)}
    for name, stored in checks(folder("droid") / "checks.json").items():
        assert check_error(ours[name], stored) < LAYERS, name


@pytest.mark.slow
@pytest.mark.parametrize("backbone", ["twins", "dino"])
def test_mvsformer(backbone: str) -> None:
    table = checks(folder("mvsformer") / f"{backbone}_checks.json")
    given = np.load(folder("mvsformer") / f"{backbone}.npz")
    net = MvsFormer(backbone).eval()
    net.load_state_dict(rule_weights(folder("mvsformer") / f"{backbone}_state_dict.json"), strict=True)
    images, poses = torch.from_numpy(given["images_rgb"]).float(), torch.from_numpy(given["extrinsics"]).double()
    cameras = torch.from_numpy(given["intrinsics"]).double().expand(3, 3, 3)
    values = given["depth_values"]
    with recorded(net) as ours, torch.no_grad():
        levels = net.features(images)
        output = net(images, poses, cameras, (values[0], values[-1]))
    ours["vit_input_view0"] = ours["vit:in"]
    for k, stage in enumerate(output.stages):
        ours[f"fusions.{k}.cost_reg.inner"] = ours[f"fusions.{k}.cost_reg:in"]
        ours[f"stage{k + 1}.depth_values"] = stage.hypotheses
        ours[f"stage{k + 1}.prob_volume_pre"] = stage.logits
        ours[f"stage{k + 1}.volume_mean"] = stage.volume
        ours |= {f"features.stage{k + 1}.view{view}": levels[k][view] for view in range(3)}
    for name, stored in table.items():
        allowed = WEIGHTS if name.endswith(".vis") else VOLUMES if name.startswith(("fusions", "stage")) else LAYERS
        assert check_error(ours[name], stored) < allowed, name
    assert error(ours["decoder_vit"][0], given["decoder_vit_view0"]) < LAYERS
    if backbone == "dino":
        # a tanh GELU would move the tokens by 1.5e-4, and nothing behind them
        assert error(ours["vit.0"][0], given["vit_tokens_view0"]) < LAYERS
        assert error(ours["vit.1"][0], given["vit_cls_attention_view0"]) < LAYERS


def test_vfuse() -> None:
    stored = np.load(folder("vfuse") / "vfuse.npz")
    net = VFuse().eval()
    net.load_state_dict(rule_weights(folder("vfuse") / "state_dict.json"), strict=True)
    cams = torch.from_numpy(stored["cams"]).double()
    depths, confidences = torch.from_numpy(stored["depths"]), torch.from_numpy(stored["confs"])
    views = FusionInput(depths, confidences, cams[:, 0], cams[:, 1, :3, :3], near=2.0, far=8.0)
    with recorded(net) as ours, torch.no_grad():
        net._regularize(torch.from_numpy(stored["volume"]))  # first, so that it is the stored volume's that is kept
        warped = torch.from_numpy(stored["warped_depths"]), torch.from_numpy(stored["warped_confs"])
        fused = net(views, "conf", warped)
    # parts of the official layers: the sigmoid, and the window's ends
    ours |= {"swo_net.conv16": torch.sigmoid(ours["swo_net.conv16"]), "swo_net": fused.bounds}
    for name, wanted in checks(folder("vfuse") / "checks.json").items():
        assert check_error(ours[name], wanted) < LAYERS, name
