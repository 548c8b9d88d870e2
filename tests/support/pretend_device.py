"""A device that is not there: its tensors lie in main memory, say that they lie elsewhere, and mix with no others.

Inside `PretendDevice`, "meta" stands for a GPU: `.to("meta")` and factories give tensors with real values that refuse
`.numpy()` and every operation together with a tensor of the CPU, as a GPU's do (a tensor without dimensions may be of
the CPU, and so may indices into one of the GPU). So code for a GPU is run, on real values, where there is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = "meta"
_COPIES = ("aten::_to_copy", "aten::copy_", "aten::set_")
_INDEXED = ("aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_")


class _Elsewhere(Tensor):
    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> _Elsewhere:
        made = Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=DEVICE,
        )  # fmt: skip
        made.inner = inner
        return made

    def new_tensor(self, data: Any, **options: Any) -> Tensor:  # type: ignore[override]
        return torch.tensor(data, dtype=options.get("dtype", self.dtype)).to(options.get("device", DEVICE))

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


_REAL_TENSOR = torch.tensor


def _tensor(data: Any, **options: Any) -> Tensor:
    device = options.pop("device", None)
    made = _REAL_TENSOR(data, **options)
    return made if device is None else made.to(device)


class PretendDevice(TorchDispatchMode):
    """While it is active, DEVICE is the pretended one; `copied`: tensors of the CPU that were copied to it."""

    def __init__(self) -> None:
        super().__init__()
        self.copied = 0

    def __enter__(self) -> Self:
        torch.tensor = _tensor  # it fills its memory without being dispatched
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        torch.tensor = _REAL_TENSOR
        super().__exit__(*error)

    def __torch_dispatch__(self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None) -> Any:
        result, name = _run(func, args, kwargs or {}), func._schema.name
        if name in _COPIES and isinstance(result, _Elsewhere):
            self.copied += not isinstance(args[1 if name == "aten::copy_" else 0], _Elsewhere)
        return result


def _run(func: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, _Elsewhere)]
    here = [tensor for tensor in tensors if not isinstance(tensor, _Elsewhere) and tensor.dim()]
    name = func._schema.name
    indices = name in _INDEXED and isinstance(args[0], _Elsewhere)
    if there and here and name not in _COPIES and not indices:
        raise RuntimeError(f"{name}: tensors of two devices, of the CPU: {[tuple(tensor.shape) for tensor in here]}")
    device = kwargs.get("device")
    elsewhere = bool(there) if device is None else torch.device(device).type == DEVICE
    if name == "aten::copy_":
        elsewhere = isinstance(args[0], _Elsewhere)
    plain_kwargs = {**kwargs, **({} if device is None else {"device": torch.device("cpu")})}
    inner_args, inner_kwargs = tree_map(lambda x: x.inner if isinstance(x, _Elsewhere) else x, (args, plain_kwargs))
    result = func(*inner_args, **inner_kwargs)
    by_inner = {id(tensor.inner): tensor for tensor in there}

    def outer(value: Any) -> Any:
        if not isinstance(value, Tensor) or not elsewhere:
            return value
        return by_inner.get(id(value)) if id(value) in by_inner else _Elsewhere(value)

    return tree_map(outer, result)
