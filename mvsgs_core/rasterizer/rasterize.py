"""One rasterizer interface over three back ends: "reference" (PyTorch), "cpu" (C++) and "triton" (GPU).

The mathematics, the same in each: EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023).

- A splat's covariance goes to the image by the projection's Jacobian at its mean, there x/z and y/z clamped to the
  image widened by 0.3 tan(fov) on every side; + 0.3 px^2 on the diagonal (`antialiased` scales the opacity by
  sqrt(det / det_blurred), so that a splat smaller than a pixel does not grow brighter by it).
- A rolling shutter reads row r of H while the camera is at pose exp(readout (r / H - 1/2)). To first order a splat's
  mean (u, v) moves by p = du/dt, with dX/dt = -translation - rotation x X, to the row at which it is read: with
  g = 1 / (1 - p_y / H) and s = g (v / H - 1/2) to (u, v) + s p. Its axes follow by the Jacobian of that, p held, to
  (x + p_x g y / H, g y). So Seiskari et al. 2024 (2403.13327), with the row solved. p is that of the clamped x/z and
  y/z, and at most half the image. One that reads columns reads the rows of an image whose axes are exchanged, and so
  it is rendered.
- alpha = min(0.99, opacity * kernel(m)); below 1/255 it is skipped. Splats are blended front to back in the order of
  float32 depth, equal depths in the order of their index; a pixel ends once its transmittance is below 1e-4 (the splat
  that brings it below is blended still).
- Color = sum w c + T background, with c = max(0, 1/2 + SH(direction from the camera)); depth = sum w z / sum w, 0 where
  nothing is seen; opacity = sum w = 1 - T.

A splat with a parameter that is not finite, a quaternion of length 0 or an extent beyond 1e8 px is left out and counted
in `Render.refused`; its gradients are 0. So are those of a splat that has one which is not finite; the "cpu" back end
counts them in `Render.backward.refused`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.rasterizer import cpu, differentiable, kernels, reference, spherical_harmonics
from mvsgs_core.rasterizer.interface import Render, RenderSettings, SplatStep
from mvsgs_core.rasterizer.splats import Splats

__all__ = ["BACKENDS", "Render", "RenderSettings", "rasterize", "se3_exp"]

BACKENDS = ("auto", "reference", "cpu", "triton")


def se3_exp(twist: Tensor) -> Tensor:
    """(4, 4) rigid transform of a twist (6,) = (translation, rotation), differentiable at 0 as well."""
    rho, omega = twist[:3], twist[3:]
    zero = torch.zeros_like(omega[0])
    k = torch.stack(
        [zero, -omega[2], omega[1], omega[2], zero, -omega[0], -omega[1], omega[0], zero]
    ).reshape(3, 3)  # fmt: skip
    generator = torch.cat([torch.cat([k, rho[:, None]], dim=1), torch.zeros_like(twist[:4])[None]], dim=0)
    return torch.linalg.matrix_exp(generator)


def rasterize(
    splats: Splats,
    world_from_cam: Tensor | np.ndarray,
    intrinsics: Tensor | np.ndarray,
    size: tuple[int, int],
    *,
    kernel: str = "gaussian",
    background: Tensor | np.ndarray | None = None,
    backend: str = "auto",
    exposure: Tensor | None = None,
    pose_delta: Tensor | None = None,
    readout: np.ndarray | None = None,
    reads_columns: bool = False,
    near: float = 1e-3,
    antialiased: bool = False,
    weights: bool = False,
    threads: int | None = None,
    step: SplatStep | None = None,
) -> Render:
    """Renders `splats` from a camera; differentiable in every tensor of `splats`, in the pose and in the exposure.

    world_from_cam: (4, 4) float64. Positions are taken relative to the camera in float64 before anything else.
    intrinsics: (fx, fy, cx, cy) in pixels at `size` = (height, width); pixel (0, 0) is the center of the first pixel.
    background: (3,) color behind the splats, black if None; carries no gradient.
    exposure: (3, 4) affine [A | b]; the color returned is A color + b.
    pose_delta: (6,) twist (translation, rotation) in the camera's frame: renders from world_from_cam @ exp(pose_delta).
    readout: (6,) twist (translation, rotation) in the camera's frame by which it moves while the image is read from the
    first row to the last; world_from_cam is its pose in the middle. None: all rows at once. Carries no gradient.
    reads_columns: from the first column to the last, that is; both coordinates of `Render.means2d` are exchanged then.
    near: splats with z <= near are left out, map units: relate it to the scene's depth.
    weights: fill `Render.weight_max` (adds about a quarter to the forward pass).
    threads: of the "cpu" back end; None = all. The result is the same for every number.
    step: that the backward pass takes, in place of gradients of the splats; of the "cpu" back end and any kernel but
    "ges_scale".
    backend: "auto" takes "triton" on a GPU and "cpu" otherwise.

    Raises ValueError for shapes, dtypes, sizes or names that do not fit and for a view of 2^31 pairs of splats and
    tiles or more, MemoryError if there is too little for the "cpu" back end, ImportError if the back end is not there.
    """
    splats.check()
    kernels.check_kernel(kernel)
    if size[0] < 1 or size[1] < 1:
        raise ValueError(f"an image of {size[0]}x{size[1]} pixels cannot be rendered")
    if kernel == "ges_scale":
        shift = kernels.log_scale_shift(splats.betas)
        splats = replace(splats, log_scales=splats.log_scales + shift[:, None], betas=splats.betas.detach())
    settings = RenderSettings(
        pose=_pose(world_from_cam, pose_delta),
        intrinsics=_floats(intrinsics, 4, "intrinsics"),
        size=(int(size[0]), int(size[1])),
        readout=(0.0,) * 6 if readout is None else _floats(readout, 6, "readout"),
        exact=kernel == "exact",
        background=(0.0, 0.0, 0.0) if background is None else _floats(background, 3, "background"),
        near=float(near),
        antialiased=antialiased,
        degree=spherical_harmonics.degree_of(splats.sh.shape[1]),
        weights=weights,
        threads=threads or 0,
    )
    if step is not None and kernel == "ges_scale":
        raise ValueError('kernel "ges_scale" cannot step the splats in the backward pass: it renders others')
    columns = reads_columns and any(settings.readout)
    render = _render(backend, splats, _exchanged(settings) if columns else settings, step)
    if columns:
        render.color = render.color.transpose(0, 1).contiguous()
        render.depth, render.opacity = render.depth.T.contiguous(), render.opacity.T.contiguous()
    if exposure is not None:
        if tuple(exposure.shape) != (3, 4):
            raise ValueError(f"exposure is {tuple(exposure.shape)}: expected (3, 4)")
        render.color = exposed(render.color, exposure.to(render.color.dtype))
    return render


def exposed(color: Tensor, exposure: Tensor) -> Tensor:
    """A color + b for colors (H, W, 3) and [A | b] (3, 4). On a CPU a matrix product of three columns takes four times
    as long as what gains of the three channels alone need, as they are mostly."""
    matrix, lift = exposure[:, :3], exposure[:, 3]
    gains = matrix.diagonal()
    if color.device.type != "cpu" or exposure.requires_grad or not torch.equal(matrix, torch.diag(gains)):
        return color @ matrix.T + lift
    return torch.addcmul(lift, color, gains)


def _render(backend: str, splats: Splats, settings: RenderSettings, step: SplatStep | None) -> Render:
    backend = chosen_backend(backend, splats.means.device)
    if step is not None:
        if backend != "cpu":
            raise ValueError(f"backend {backend!r} cannot step the splats in the backward pass")
        return differentiable.render_stepping(cpu, splats, settings, step)
    if backend == "reference":
        return reference.render(splats, settings)
    if backend == "cpu" and differentiable.trains_opacities_alone(splats, settings):
        return differentiable.render_for_opacities(cpu, splats, settings)
    if backend == "cpu":
        return differentiable.render(cpu, splats, settings)
    if backend == "triton":
        from mvsgs_core.rasterizer.triton import backend as triton_backend

        return differentiable.render(triton_backend, splats, settings)
    raise ValueError(f"backend {backend!r}: choose one of {', '.join(BACKENDS)}")


def chosen_backend(backend: str, device: torch.device) -> str:
    """What "auto" means for splats on this device."""
    if backend != "auto":
        return backend
    return "cpu" if device.type == "cpu" else "triton"


def _exchanged(settings: RenderSettings) -> RenderSettings:
    """The same camera with the axes of its image exchanged. Its own axes are then left-handed, which nothing asks for;
    a rotation turns the other way round."""
    fx, fy, cx, cy = settings.intrinsics
    v_x, v_y, v_z, w_x, w_y, w_z = settings.readout
    return replace(
        settings, pose=settings.pose[:, [1, 0, 2, 3]], intrinsics=(fy, fx, cy, cx), size=settings.size[::-1],
        readout=(v_y, v_x, v_z, -w_y, -w_x, -w_z),
    )  # fmt: skip


def _pose(world_from_cam: Tensor | np.ndarray, delta: Tensor | None) -> Tensor:
    pose = torch.as_tensor(world_from_cam).to(device="cpu", dtype=torch.float64)
    if tuple(pose.shape) != (4, 4):
        raise ValueError(f"world_from_cam is {tuple(pose.shape)}: expected (4, 4)")
    if not bool(torch.isfinite(pose).all()):
        raise ValueError("world_from_cam is not finite")
    return pose if delta is None else pose @ se3_exp(delta.to(device="cpu", dtype=torch.float64))


def _floats(values: Tensor | np.ndarray, count: int, name: str) -> tuple[float, ...]:
    array = torch.as_tensor(values).detach().double().cpu().reshape(-1)
    if len(array) != count or not bool(torch.isfinite(array).all()):
        raise ValueError(f"{name}: expected {count} finite numbers, got {array.tolist()}")
    return tuple(array.tolist())
