"""Whatever is raised while a map changes, it is as it was before or as it is after."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mvsgs_core.mapping.map_state import MapState
from mvsgs_core.rasterizer.splats import Splats

COUNT = 9
GONE = torch.arange(COUNT) % 3 == 0


class Failing(TorchDispatchMode):
    """Raises in place of one operation on tensors, and goes on with the next."""

    def __init__(self, error: BaseException, at: int) -> None:
        super().__init__()
        self.error, self.left = error, at

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.left -= 1
        if self.left == -1:
            raise self.error
        return func(*args, **(kwargs or {}))


def splats(count: int, value: float) -> Splats:
    shapes = [(count, 3), (count, 3), (count, 4), (count,), (count, 4, 3), (count,)]
    return Splats(*(torch.full(shape, value) for shape in shapes))


def made(value: float) -> MapState:
    """Every row is another one."""
    state = MapState(4, torch.device("cpu"))
    state.append(splats(COUNT, value), torch.arange(COUNT))
    for tensor in state.tensors().values():
        tensor += torch.arange(COUNT).reshape(-1, *[1] * (tensor.dim() - 1)).to(tensor.dtype)
    return state


def copied(state: MapState) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in state.tensors().items()}


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.append(splats(4, 7.0), torch.arange(4)),
        lambda state: state.take_over(made(7.0)),
        lambda state: state.keep(~GONE),
        lambda state: state.become(made(7.0).tensors()),
        lambda state: state.become({name: value[:4] for name, value in made(7.0).tensors().items()}),
    ],
    ids=["append", "take_over", "keep", "become", "become smaller"],
)
@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError("no room")], ids=["Ctrl-C", "memory"])
def test_a_change_that_is_cut_off_leaves_a_whole_map(change: Callable[[MapState], None], error: BaseException) -> None:
    before, state = copied(made(1.0)), made(1.0)
    change(state)
    after, found = copied(state), []
    for at in range(1000):
        state = made(1.0)
        try:
            with Failing(error, at):
                change(state)
        except type(error):
            now = copied(state)
            assert len(state) == len(state.splats)
            assert all(value.requires_grad and value.is_leaf for value in state.splats.tensors().values())
            found.append("before" if same(now, before) else "after" if same(now, after) else "neither")
        else:
            break
    assert len(found) > 21, "more than one for each tensor"
    assert "neither" not in found


def test_a_map_that_was_cut_off_while_it_grew_goes_on() -> None:
    state = made(1.0)
    with pytest.raises(MemoryError), Failing(MemoryError(), 60):
        state.append(splats(4, 7.0), torch.arange(4))
    assert len(state) == COUNT
    state.append(splats(4, 7.0), torch.arange(4))
    state.keep(torch.arange(COUNT + 4) >= COUNT)
    assert {len(value) for value in state.tensors().values()} == {4}
    assert (state.splats.means == 7.0).all()


def test_the_largest_tensors_change_first() -> None:
    """What they leave has room for each of the others: where memory is short, nothing has changed yet."""
    state, rows = made(1.0), []

    class Sizes(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            if func is torch.ops.aten.index.Tensor:
                rows.append(args[0].nbytes)
            return func(*args, **(kwargs or {}))

    with Sizes():
        state.keep(~GONE)
    assert len(rows) == 22
    assert rows == sorted(rows, reverse=True)
