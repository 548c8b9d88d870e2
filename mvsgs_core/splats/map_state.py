"""The growing map: splats with everything that is kept for each of them; all of it grows and shrinks together."""

from __future__ import annotations

import torch
from torch import Tensor

from mvsgs_core.splats.model import Splats

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh", "betas")


class MapState:
    """Trainable splats (leaf tensors), their Adam moments and step counts, anchors and screen gradients.

    `first` and `second` hold one tensor a parameter, of the parameter's shape. `steps` (N,) int32 counts the Adam steps
    of each splat: splats of an online map differ in age. `anchors` (N,) int64 is the keyframe that a splat moves with.
    `screen_gradient` (N,) and `screen_views` (N,) accumulate what density control decides on.
    """

    def __init__(self, sh_bases: int, device: torch.device) -> None:
        widths = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": (), "betas": ()}
        empty = {name: torch.zeros((0, *shape), device=device) for name, shape in widths.items()}
        empty["sh"] = torch.zeros((0, sh_bases, 3), device=device)
        self.splats = _leaves(empty)
        self.first = {name: torch.zeros_like(value) for name, value in empty.items()}
        self.second = {name: torch.zeros_like(value) for name, value in empty.items()}
        self.steps = torch.zeros(0, dtype=torch.int32, device=device)
        self.anchors = torch.zeros(0, dtype=torch.int64, device=device)
        self.screen_gradient = torch.zeros(0, device=device)
        self.screen_views = torch.zeros(0, device=device)

    def __len__(self) -> int:
        return len(self.steps)

    @property
    def device(self) -> torch.device:
        return self.steps.device

    @torch.no_grad()
    def append(self, new: Splats, anchors: Tensor, steps: Tensor | None = None) -> None:
        """Adds splats with moments of zero. `steps`: their age; 0 unless they descend from older splats."""
        count = len(anchors)
        values, first, second = {}, {}, {}
        for name in PARAMETERS:
            added = getattr(new, name).detach().to(self.device)
            zeros = torch.zeros_like(added)
            values[name] = torch.cat([getattr(self.splats, name).detach(), added])
            first[name] = torch.cat([self.first[name], zeros])
            second[name] = torch.cat([self.second[name], zeros])
        self.splats, self.first, self.second = _leaves(values), first, second
        age = torch.zeros(count, dtype=torch.int32, device=self.device) if steps is None else steps
        zeros = torch.zeros(count, device=self.device)
        self.steps = torch.cat([self.steps, age])
        self.anchors = torch.cat([self.anchors, anchors.to(self.device)])
        self.screen_gradient = torch.cat([self.screen_gradient, zeros])
        self.screen_views = torch.cat([self.screen_views, zeros])

    @torch.no_grad()
    def take_over(self, other: MapState) -> None:
        """Adds all splats of another map with their moments, ages, anchors and gradients; `other` stays as it is."""
        values = {}
        for name in PARAMETERS:
            values[name] = torch.cat([getattr(s.splats, name).detach() for s in (self, other)])
            self.first[name] = torch.cat([self.first[name], other.first[name]])
            self.second[name] = torch.cat([self.second[name], other.second[name]])
        self.splats = _leaves(values)
        self.steps = torch.cat([self.steps, other.steps])
        self.anchors = torch.cat([self.anchors, other.anchors])
        self.screen_gradient = torch.cat([self.screen_gradient, other.screen_gradient])
        self.screen_views = torch.cat([self.screen_views, other.screen_views])

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Drops the splats where `mask` (N,) bool is False."""
        self.splats = _leaves({name: getattr(self.splats, name).detach()[mask] for name in PARAMETERS})
        self.first = {name: value[mask] for name, value in self.first.items()}
        self.second = {name: value[mask] for name, value in self.second.items()}
        self.steps, self.anchors = self.steps[mask], self.anchors[mask]
        self.screen_gradient, self.screen_views = self.screen_gradient[mask], self.screen_views[mask]

    @torch.no_grad()
    def grow_sh(self, bases: int) -> None:
        """Appends spherical harmonics of zero up to `bases` = (degree + 1)^2; never removes any."""
        missing = bases - self.splats.sh.shape[1]
        if missing <= 0:
            return
        values = {name: getattr(self.splats, name).detach() for name in PARAMETERS}
        padding = torch.zeros((len(self), missing, 3), device=self.device)
        values["sh"] = torch.cat([values["sh"], padding], dim=1)
        self.first["sh"] = torch.cat([self.first["sh"], padding], dim=1)
        self.second["sh"] = torch.cat([self.second["sh"], padding], dim=1)
        self.splats = _leaves(values)

    @torch.no_grad()
    def accumulate_screen(self, gradient: Tensor, visible: Tensor) -> None:
        """Adds the norms (N,) of the screen-space gradients of one view, where it saw the splat."""
        self.screen_gradient += torch.where(visible, gradient, 0.0)
        self.screen_views += visible

    def reset_screen(self) -> None:
        self.screen_gradient.zero_()
        self.screen_views.zero_()

    def detached(self) -> Splats:
        """A view of the splats that no gradient reaches; shares memory."""
        return Splats(**{name: value.detach() for name, value in self.splats.tensors().items()})


def replace_values(state: MapState, values: dict[str, Tensor]) -> None:
    """New values of all parameters, of the same number of splats; moments and gradients are left alone."""
    state.splats = _leaves(values)


def _leaves(values: dict[str, Tensor]) -> Splats:
    return Splats(**{name: value.detach().contiguous().requires_grad_(True) for name, value in values.items()})
