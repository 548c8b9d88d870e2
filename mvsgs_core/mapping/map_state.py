"""The growing map: splats with everything that is kept for each of them; all of it grows and shrinks together."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from mvsgs_core.rasterizer.splats import Splats

PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh", "betas")
SINGLE = ("steps", "anchors", "means2d_gradient", "means2d_views")  # one value a splat beside the parameters


class MapState:
    """Trainable splats (leaf tensors), their Adam moments and step counts, anchors and screen gradients.

    `first` and `second` hold one tensor a parameter, of the parameter's shape. `steps` (N,) int32 counts the Adam steps
    of each splat: splats of an online map differ in age. `anchors` (N,) int64 is the keyframe that a splat moves with.
    `means2d_gradient` (N,) and `means2d_views` (N,) accumulate what density control decides on.
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
        self.means2d_gradient = torch.zeros(0, device=device)
        self.means2d_views = torch.zeros(0, device=device)

    def __len__(self) -> int:
        return len(self.steps)

    def tensors(self) -> dict[str, Tensor]:
        """All that is kept for the splats, by name, detached; gradients, which live for an iteration, are left out."""
        found = {name: value.detach() for name, value in self.splats.tensors().items()}
        for moment, values in (("first", self.first), ("second", self.second)):
            found |= {f"{moment}/{name}": values[name] for name in PARAMETERS}
        return found | {name: getattr(self, name) for name in SINGLE}

    @classmethod
    def of(cls, tensors: dict[str, Tensor], device: torch.device) -> MapState:
        """The state that has these `tensors()`, copied to `device`."""
        state = cls(tensors["sh"].shape[1], device)
        copies = {name: value.detach().to(device, copy=True) for name, value in tensors.items()}
        state.splats = _leaves({name: copies[name] for name in PARAMETERS})
        for name in PARAMETERS:
            state.first[name], state.second[name] = copies[f"first/{name}"], copies[f"second/{name}"]
        for name in SINGLE:
            setattr(state, name, copies[name])
        return state

    @property
    def device(self) -> torch.device:
        return self.steps.device

    @torch.no_grad()
    def append(self, new: Splats, anchors: Tensor, steps: Tensor | None = None) -> None:
        """Adds splats with moments of zero. `steps`: their age; 0 unless they descend from older splats."""
        zeros = torch.zeros(len(anchors), device=self.device)
        added = {name: getattr(new, name).detach().to(self.device) for name in PARAMETERS}
        for moment in ("first", "second"):
            added |= {f"{moment}/{name}": torch.zeros_like(added[name]) for name in PARAMETERS}
        added |= {
            "steps": zeros.to(torch.int32) if steps is None else steps, "anchors": anchors.to(self.device),
            "means2d_gradient": zeros, "means2d_views": zeros,
        }  # fmt: skip
        self._grow(added)

    @torch.no_grad()
    def take_over(self, other: MapState) -> None:
        """Adds all splats of another map with their moments, ages, anchors and gradients; `other` stays as it is."""
        self._grow(other.tensors())

    @torch.no_grad()
    def become(self, tensors: dict[str, Tensor]) -> None:
        """Has these `tensors()` in place of its own; whoever holds the state goes on with them."""
        self._replace(lambda name, _: tensors[name])

    @torch.no_grad()
    def keep(self, mask: Tensor) -> None:
        """Drops the splats where `mask` (N,) bool is False."""
        count = int(mask.sum())
        if count < len(mask):
            self._replace(lambda _, value: value if len(value) == count else value[mask])

    @torch.no_grad()
    def accumulate_means2d(self, gradient: Tensor, visible: Tensor) -> None:
        """Adds the norms (N,) of the screen-space gradients of one view, finite, where it saw the splat."""
        self.means2d_gradient.addcmul_(gradient, visible.to(gradient))
        self.means2d_views += visible

    def reset_means2d(self) -> None:
        self.means2d_gradient.zero_()
        self.means2d_views.zero_()

    def _grow(self, added: dict[str, Tensor]) -> None:
        before = len(self)
        self._replace(lambda name, value: torch.cat([value, added[name]]), lambda _, value: value[:before])

    def _replace(
        self, change: Callable[[str, Tensor], Tensor], undo: Callable[[str, Tensor], Tensor] | None = None
    ) -> None:
        """Every one of `tensors()`, by name, becomes what `change` makes of it; one after the other, so that each is
        freed when the new one takes its place: all at once would need the whole map's memory a second time.

        What is raised on the way leaves them as they were, by `undo`, which may be given one that has not changed, or
        without it as they are to be, by `change`, which may be given one that has. The largest come first: where memory
        is short, nothing has changed yet.
        """
        sizes = {name: value.nbytes for name, value in self.tensors().items()}
        names = sorted(sizes, key=lambda name: sizes[name], reverse=True)
        try:
            for name in names:
                self._put(name, change(name, self.tensors()[name]))
        except BaseException:
            for name in names:
                self._put(name, (undo or change)(name, self.tensors()[name]))
            raise

    def _put(self, name: str, value: Tensor) -> None:
        """In place of the one of `tensors()` that has this name."""
        moment, _, parameter = name.rpartition("/")
        if moment:
            getattr(self, moment)[parameter] = value
        elif name in PARAMETERS:
            setattr(self.splats, name, _leaf(value))
        else:
            setattr(self, name, value)

    def detached(self) -> Splats:
        """A view of the splats that no gradient reaches; shares memory."""
        return Splats(**{name: value.detach() for name, value in self.splats.tensors().items()})


def _leaves(values: dict[str, Tensor]) -> Splats:
    return Splats(**{name: _leaf(value) for name, value in values.items()})


def _leaf(value: Tensor) -> Tensor:
    return value.detach().contiguous().requires_grad_(True)
