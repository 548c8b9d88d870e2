"""Loads the official checkpoints into our networks, with each conversion stated. No pickle is ever executed."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from mvsgs_core import weights
from mvsgs_core.bad_file import BadFileError, reading

RANDOM = "random"  # instead of a file
_LONGEST = 400  # characters of what does not fit

N = TypeVar("N", bound=nn.Module)


def read(file: Path, *, inside: str | None = None) -> dict[str, Tensor]:
    """State dict of a checkpoint: the prefix `module.` goes, and so does all that is no tensor.

    inside: key under which the file keeps it ("state_dict", "model", ...). Raises FileNotFoundError, or BadFileError,
    saying what is wrong, for a file that is truncated, no checkpoint, or holds code.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no weights at {file}")
    with reading(file, "is truncated or no PyTorch checkpoint"):
        try:
            content: Any = torch.load(file, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            content = _with_configuration(file)
    if inside is not None:
        if not isinstance(content, Mapping) or inside not in content:
            raise BadFileError(f"{file} has no {inside!r}: it is another checkpoint")
        content = content[inside]
    if not isinstance(content, Mapping):
        raise BadFileError(f"{file} holds a {type(content).__name__}, no state dict")
    state = {str(k).removeprefix("module."): v for k, v in content.items() if isinstance(v, Tensor)}
    if not state:
        raise BadFileError(f"{file} holds no tensors")
    return state


class _Placeholder:
    """In the place of an object that is none of PyTorch's: takes whatever the file gives it, keeps and does nothing."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        pass


def _with_configuration(file: Path) -> Any:
    """A checkpoint that also pickles its configuration (MVSFormer's do), every such object as a placeholder.

    No name of the file is imported or called, so that loading stays as safe as that of tensors alone.
    """
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(file)
        with torch.serialization.safe_globals([(_Placeholder, name) for name in names]):
            return torch.load(file, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, ValueError, TypeError, AttributeError) as error:
        raise BadFileError(
            f"{file} holds Python objects beside the weights, which are not executed ({str(error).splitlines()[0]}); "
            "save its state dict alone, in an environment that you trust: "
            "torch.save(torch.load(FILE, weights_only=False)['state_dict'], NEW_FILE)"
        ) from error


def load(net: nn.Module, state: Mapping[str, Tensor], file: Path) -> None:
    """Loads strictly: every key used, every parameter set. Raises BadFileError naming what does not fit."""
    try:
        net.load_state_dict(dict(state), strict=True)
    except RuntimeError as error:
        what = " ".join(str(error).split())  # of a wrong file, all keys on hundreds of lines
        what = what if len(what) < _LONGEST else f"{what[:_LONGEST]} ..."
        raise BadFileError(f"{file} does not fit {type(net).__name__}: {what}") from error
    net.eval().requires_grad_(False)


def load_registered(
    net: nn.Module,
    name: str,
    file: str | Path | None = None,
    *,
    inside: str | None = None,
    convert: Callable[[Mapping[str, Tensor]], dict[str, Tensor]] = dict,
) -> Path:
    """Loads the weights `name` of the registry, from `file` or where it finds them, and returns the file.

    Raises FileNotFoundError, or BadFileError for a truncated or wrong file; both say what to fetch from where.
    """
    path = weights.find(name, file)
    try:
        load(net, convert(read(path, inside=inside)), path)
    except ValueError as error:
        raise BadFileError(f"{error}; for the right one: {weights.remedy(name)}") from error
    return path


def make(build: Callable[[], N], name: str, file: str | None, *, inside: str) -> N:
    """`build()`, ready for inference, with the weights `name` of the registry; untrained, but always the same, where

    `file` is RANDOM. Raises what `load_registered` raises.
    """
    if file == RANDOM:
        torch.manual_seed(0)
    net = build()
    if file != RANDOM:
        load_registered(net, name, file, inside=inside)
    return net.eval().requires_grad_(False)


def droid_rows(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """DROID's file holds a third output row in two heads that its own loader cuts off."""
    cut = {"update.weight.2.weight", "update.weight.2.bias", "update.delta.2.weight", "update.delta.2.bias"}
    return {key: value[:2] if key in cut else value for key, value in state.items()}
