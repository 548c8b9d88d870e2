"""Loads the official checkpoints into our networks, with each conversion stated. No pickle is ever executed."""

from __future__ import annotations

import pickle
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from mvsgs_core import weights
from mvsgs_core.bad_file import BadFileError, reading

RANDOM = "random"  # instead of a file
_MAGIC = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19"  # with which files that PyTorch wrote before 2020 begin
_LONGEST = 400  # characters of what does not fit
_PLACES = ("state_dict", "model", "model_state_dict")  # keys under which state dicts are kept beside other things

N = TypeVar("N", bound=nn.Module)


def read(file: Path, *, inside: str | None = None, mapped: bool = False) -> dict[str, Tensor]:
    """State dict of a checkpoint: the prefix `module.` goes, and so does all that is no tensor of real numbers.

    inside: key under which the published file keeps it; one at the top level, or under another usual key, is taken too.
    mapped: the tensors are parts of the file, which are read as they are looked at. Raises FileNotFoundError, or
    BadFileError, saying what is wrong, for a file that is truncated, no checkpoint, or holds code.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no weights at {file}")
    with reading(file, "is truncated or no PyTorch checkpoint"):
        if weights.is_web_page(file):
            raise BadFileError(f"{file} is a web page, as comes where a link asks something first: use a browser")
        content = _content(file, inside, mapped)
        if not isinstance(content, Mapping):
            what = "one pickled Python object" if isinstance(content, _Placeholder) else f"a {type(content).__name__}"
            raise BadFileError(f"{file} holds {what}, no state dict")
        for place in (content.get(inside), content, *(content.get(key) for key in _PLACES)):
            if state := _tensors(place):
                return state
    keys = ", ".join(repr(key) for key in content)
    raise BadFileError(
        f"{file} holds no tensors, neither right in it nor under {', '.join(_PLACES)}; its keys: {_cut(keys) or 'none'}"
    )


def _tensors(place: Any) -> dict[str, Tensor]:
    if not isinstance(place, Mapping):
        return {}
    found = {str(key).removeprefix("module."): value for key, value in place.items() if isinstance(value, Tensor)}
    return {k: v for k, v in found.items() if v.layout == torch.strided and not (v.is_meta or v.is_complex())}


def _content(file: Path, inside: str | None, mapped: bool) -> Any:
    """A checkpoint may also pickle its configuration (MVSFormer's do): every such object becomes a placeholder.

    No name of the file is imported or called, so that loading stays as safe as that of tensors alone.
    """
    zipped = zipfile.is_zipfile(file)  # as PyTorch writes since 2020

    def load() -> Any:
        return torch.load(file, map_location="cpu", weights_only=True, mmap=mapped and zipped)

    try:
        return load()
    except pickle.UnpicklingError as error:
        if zipped:
            names = torch.serialization.get_unsafe_globals_in_checkpoint(file)
        else:
            names = re.findall(r"GLOBAL ([\w.]+)", str(error)) if _begins_with(file, _MAGIC) else []
        if not names:  # what PyTorch says then is to load it with all that it holds, whatever it is
            raise BadFileError(f"{file} is truncated or no PyTorch checkpoint of tensors") from error
    try:
        with torch.serialization.safe_globals([(_Placeholder, name) for name in names]):
            return load()
    except (pickle.UnpicklingError, ValueError, TypeError, AttributeError) as error:
        taken = "" if inside is None else f"[{inside!r}]"
        raise BadFileError(
            f"{file} holds Python objects beside the weights, which are not executed ({_cut(', '.join(sorted(names)))}"
            "); save its state dict alone, in an environment that you trust: "
            f"torch.save(torch.load(FILE, weights_only=False){taken}, NEW_FILE)"
        ) from error


def _begins_with(file: Path, content: bytes) -> bool:
    with file.open("rb") as opened:
        return opened.read(len(content)) == content


class _Placeholder:
    """In the place of an object that is none of PyTorch's: takes whatever the file gives it, keeps and does nothing."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        pass


def load(net: nn.Module, state: Mapping[str, Tensor], file: Path, *, assign: bool = False) -> None:
    """Loads strictly: every key used, every parameter set and finite. Raises BadFileError naming what does not fit.

    assign: the network's tensors become those of the state, as one needs that has shapes alone.
    """
    try:
        net.load_state_dict(dict(state), strict=True, assign=assign)
    except RuntimeError as error:
        what = " ".join(str(error).split())  # of a wrong file, all keys on hundreds of lines
        raise BadFileError(f"{file} does not fit {type(net).__name__}: {_cut(what)}") from error
    wrong = [key for key, value in state.items() if not bool(torch.isfinite(value).all())]
    if wrong:
        raise BadFileError(
            f"{file} has values that are not finite in {len(wrong)} of {len(state)} tensors, as in {wrong[0]}: "
            "it is damaged, or its training went wrong"
        )
    net.eval().requires_grad_(False)


def _cut(text: str) -> str:
    return text if len(text) < _LONGEST else f"{text[:_LONGEST]} ..."


def load_registered(
    net: nn.Module,
    name: str,
    file: str | Path | None = None,
    *,
    inside: str | None = None,
    convert: Callable[[Mapping[str, Tensor]], dict[str, Tensor]] = dict,
    assign: bool = False,
) -> Path:
    """Loads the weights `name` of the registry, from `file` or where it finds them, and returns the file.

    assign: see `load`; the tensors then are parts of the file. Raises FileNotFoundError, or BadFileError for a
    truncated or wrong file; both say what to fetch from where.
    """
    path = weights.find(name, file)
    try:
        load(net, convert(read(path, inside=inside, mapped=assign)), path, assign=assign)
    except ValueError as error:
        raise BadFileError(f"{error}; for the right one: {weights.remedy(name)}") from error
    return path


def check(
    build: Callable[[], nn.Module],
    name: str,
    file: str | None,
    *,
    inside: str | None = None,
    convert: Callable[[Mapping[str, Tensor]], dict[str, Tensor]] = dict,
) -> None:
    """Raises what `load_registered` would, before a network of `build` is needed: nothing is copied or computed."""
    if file != RANDOM:
        with torch.device("meta"):
            net = build().requires_grad_(False)
        load_registered(net, name, file, inside=inside, convert=convert, assign=True)


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
    return {key: value[:2] if key in cut and value.ndim else value for key, value in state.items()}
