"""What is thrown at the map, and that neither it nor a render ever becomes NaN or Inf.

`python -m bench.stability [--quick] [--json FILE]`. Each row says what happened, what was refused and how it was
reported. The first rows take one render, one backward pass and one optimizer step; the last ones the whole mapper. A
row's goal says what it looks at: that all values are finite, and where the map must be good in spite of what was done
to it, how well it renders its keyframes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from bench.table import Row, main
from mvsgs_core import camera
from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.config import MapperConfig, TrainingConfig
from mvsgs_core.mapping.keyframes import RGBDKeyframe
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.mapping.mapper import OnlineMapper
from mvsgs_core.mapping.optimizer import OptimizerConfig
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats
from mvsgs_core.rasterizer.ssim import image_loss

FINITE = "render and map finite"
GOOD = 40.0  # dB of the keyframes: what bad input was refused must not cost the rest
FEWER_DEPTHS = 25.0  # dB, where a third of each view has no depth
SIZE = (48, 64)
INTRINSICS = np.array([50.0, 50.0, 31.5, 23.5])


def cloud(count: int, seed: int = 0) -> Splats:
    """Ordinary splats in front of a camera at the origin."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand((count, 3), generator=generator) * torch.tensor([2.4, 1.8, 2.0]) + torch.tensor(
        [-1.2, -0.9, 1.0]
    )
    return Splats(
        means, torch.rand((count, 3), generator=generator) * 1.5 - 4.0, torch.randn((count, 4), generator=generator),
        torch.randn(count, generator=generator), torch.randn((count, 4, 3), generator=generator) * 0.5,
        torch.full((count,), 2.0),
    )  # fmt: skip


def near_plane(splats: Splats) -> None:
    splats.means[:, 2] = torch.cat([torch.linspace(-2.0, 0.0, 100), torch.logspace(-6, -2, 100)])
    splats.means[:, :2] *= 0.3 * splats.means[:, 2:].abs()  # inside of the image where in front


def scales(splats: Splats) -> None:
    splats.log_scales = torch.log(torch.logspace(-12, 6, 200))[:, None].repeat(1, 3)


def aspects(splats: Splats) -> None:
    splats.log_scales[:, 0] = 2.0
    splats.log_scales[:, 1:] = 2.0 - np.log(1e5)


def opacities(splats: Splats) -> None:
    splats.opacity_logits = torch.logit(torch.linspace(0.0, 1.0, 200))  # the ends are -Inf and Inf


def betas(splats: Splats) -> None:
    splats.betas = torch.logspace(-1, np.log10(20.0), 200)


def coincident(splats: Splats) -> None:
    splats.means[:] = splats.means[0]


def one_tile(splats: Splats) -> None:
    splats.means[:, :2] *= 0.01


def not_finite(splats: Splats) -> None:
    splats.means[0, 0], splats.log_scales[1, 2], splats.quaternions[2] = torch.nan, torch.inf, torch.zeros(4)
    splats.sh[3, 0, 1], splats.opacity_logits[4] = -torch.inf, torch.nan


def far_away(splats: Splats) -> None:
    splats.means[:, 0] += 1e6


CHANGES: dict[str, tuple[Callable[[Splats], None], dict[str, Any]]] = {  # of 200 splats; how they are rendered
    "splats at and behind the near plane": (near_plane, {}),
    "scales from 1e-12 to 1e6": (scales, {}),
    "aspect 1:1e5": (aspects, {}),
    "opacity 0 to 1": (opacities, {}),
    "coincident splats": (coincident, {}),
    "zero splats": (lambda splats: None, {"count": 0}),
    "10,000 splats on one tile": (one_tile, {"count": 10_000}),
    "NaN and Inf in the splats themselves": (not_finite, {}),
    "beta from 0.1 to 20, exact": (betas, {"kernel": "exact"}),
    "beta from 0.1 to 20, ges_scale": (betas, {"kernel": "ges_scale"}),
    "one pixel": (lambda splats: None, {"size": (1, 1)}),
    "world origin 1e6 away, float32 means": (far_away, {"origin": 1e6}),
}


def once(
    name: str, change: Callable[[Splats], None], count: int = 200, size: tuple[int, int] = SIZE,
    kernel: str = "gaussian", origin: float = 0.0,
) -> Row:  # fmt: skip
    """One render, backward pass and step of ordinary splats that were changed."""
    splats = cloud(count)
    change(splats)
    state = MapState(splats.sh.shape[1], torch.device("cpu"))
    state.append(splats, torch.zeros(len(splats), dtype=torch.int64))
    pose = np.eye(4)
    pose[0, 3] = origin
    before = {key: torch.isfinite(value).flatten(1).all(1) if value.dim() > 1 else torch.isfinite(value)
              for key, value in state.detached().tensors().items()}  # fmt: skip
    intrinsics = camera.scale_intrinsics(INTRINSICS, SIZE, size)
    render = rasterize(state.splats, pose, intrinsics, size, kernel=kernel)
    target = torch.full((*size, 3), 0.5)
    loss = image_loss(render.color, target, l1_weight=0.8, ssim_weight=0.2)
    refused_steps = 0
    if len(splats):
        (loss + render.depth.mean() + render.opacity.mean()).backward()
        groups = optimizer.groups(OptimizerConfig(), 2.0, 1.0, True, kernel)
        refused_steps = optimizer.step(state, render.visible, groups, 100)
    finite = all(bool(torch.isfinite(value).all()) for value in (render.color, render.depth, render.opacity))
    spread_no_further = all(
        bool((torch.isfinite(value).flatten(1).all(1) if value.dim() > 1 else torch.isfinite(value))[before[key]].all())
        for key, value in state.detached().tensors().items()
    )
    text = (
        f"{int(render.visible.sum())} of {len(splats)} seen, {render.refused} left out, "
        f"{render.backward.refused or 0} gradients and {refused_steps} steps refused"
    )
    return Row(name, text, "", FINITE, finite and spread_no_further)


def box_view(index: int, x: float, size: tuple[int, int] = SIZE, origin: float = 0.0) -> RGBDKeyframe:
    """A textured plane two units ahead, seen from x."""
    height, width = size
    intrinsics = camera.scale_intrinsics(INTRINSICS, SIZE, size)
    points = camera.unproject(np.full(size, 2.0), intrinsics)
    points[..., 0] += x
    phase = np.array([0.0, 1.0, 2.0])
    waves = 0.5 + 0.2 * np.sin(6.0 * points[..., [0, 1, 0]] + phase) + 0.2 * np.cos(9.0 * points[..., [1, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = x + origin
    image = np.round(255.0 * np.clip(waves, 0.0, 1.0)).astype(np.uint8)
    normals = np.broadcast_to(np.array([0.0, 0.0, -1.0], dtype=np.float32), (height, width, 3)).copy()
    return RGBDKeyframe(index, image, intrinsics, pose, np.full(size, 2.0, dtype=np.float32), normals=normals)


def mapped(name: str, views: list[RGBDKeyframe], config: MapperConfig, minimum: float | None = None) -> Row:
    """The whole mapper on these views; minimum: dB that its keyframes must reach, None: only finiteness counts."""
    mapper = OnlineMapper(config)
    for posed in views:
        mapper.add_keyframe(posed)
    while mapper.step():
        pass
    state_finite = all(bool(torch.isfinite(getattr(mapper.state.splats, key)).all()) for key in PARAMETERS)
    moments = (*mapper.state.first.values(), *mapper.state.second.values())
    state_finite = state_finite and all(bool(torch.isfinite(value).all()) for value in moments)
    renders = [mapper.render(view) for view in mapper.views]
    finite = state_finite and all(bool(torch.isfinite(r.color).all()) for r in renders)
    scores = []
    for render, view in zip(renders, mapper.views, strict=True):
        squared = ((render.color - view.target) ** 2).mean(dim=-1)
        mean = float(squared.mean() if view.valid is None else squared[view.valid].mean())
        scores.append(10.0 * np.log10(1.0 / max(mean, 1e-12)))
    refused = {key: int(value) for key, value in mapper.log.counts.items() if key.startswith("refused")}
    reached = float(np.mean(scores)) if scores else 0.0
    score = f"{reached:.1f} dB" if scores else "no view"
    text = f"{mapper.iterations} iterations, {len(mapper.state)} splats, {score}; refused {refused or 'nothing'}"
    goal = f"{FINITE}, quality not judged" if minimum is None else f"{FINITE}, >= {minimum:g} dB"
    met = finite and (minimum is None or reached >= minimum)
    return Row(name, f"{text}; {len(mapper.log.warnings)} warnings", "", goal, met)


def with_bad_pixels(view: RGBDKeyframe) -> RGBDKeyframe:
    image = view.image.astype(np.float32) / 255.0
    image[4:9, 5:20] = np.nan
    return replace(view, image=image)


def with_bad_depths(view: RGBDKeyframe) -> RGBDKeyframe:
    depth = view.depth.copy()
    depth[:9] = np.nan
    depth[9:12] = np.inf
    depth[12:15] = -2.0
    return replace(view, depth=depth)


def measure(options: argparse.Namespace) -> list[Row]:
    torch.set_num_threads(1)
    rows = [once(name, change, **how) for name, (change, how) in CHANGES.items()]
    config = MapperConfig(iterations=40, threads=1)
    views = [box_view(k, 0.2 * k) for k in range(4)]
    rows.append(mapped("mapper, nothing wrong", views, config, GOOD))
    away = [box_view(k, 0.2 * k, origin=1e6) for k in range(4)]
    rows.append(mapped("mapper, world origin 1e6 away", away, config, GOOD))
    rows.append(mapped("mapper, NaN pixels", [with_bad_pixels(view) for view in views], config, GOOD))
    bad_depths = [with_bad_depths(view) for view in views]
    rows.append(mapped("mapper, NaN, Inf and negative depths", bad_depths, config, FEWER_DEPTHS))
    lost = [replace(views[0], world_from_cam=np.full((4, 4), np.nan)), *(box_view(k + 1, 0.2 * k) for k in range(4))]
    rows.append(mapped("mapper, NaN pose", lost, config, GOOD))
    rows.append(mapped("mapper, images of one pixel", [box_view(k, 0.2 * k, size=(1, 1)) for k in range(3)], config))
    steps = 2_000 if options.quick else 20_000
    usual = OptimizerConfig()
    wild = replace(usual, **{key: 100.0 * value for key, value in vars(usual).items()
                             if key not in ("means_final", "decay_steps", "max_scale_in_stream")})  # fmt: skip
    for kernel in ("gaussian", "exact"):
        training = TrainingConfig(kernel=kernel, betas=True)
        convergence = replace(config.convergence, skip=False)
        storm = replace(config, iterations=steps // 4, optimizer=wild, training=training, convergence=convergence)
        rows.append(mapped(f"{steps} steps at 100 times the rates, {kernel}", views, storm))
    return rows


if __name__ == "__main__":
    main(measure, "Stability of the map")
