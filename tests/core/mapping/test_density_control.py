"""Clone, split and prune: counts, bookkeeping and what the render keeps."""

from __future__ import annotations

import math

import pytest
import torch

from mvsgs_core.mapping.config import MapperConfig
from mvsgs_core.mapping.density_control import DensityControlConfig, control, removable
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.rasterizer.splats import Splats


def state_of(count: int) -> MapState:
    state = MapState(1, torch.device("cpu"))
    generator = torch.Generator().manual_seed(0)
    state.append(
        Splats(
            torch.randn((count, 3), generator=generator), torch.full((count, 3), math.log(0.005)),
            torch.randn((count, 4), generator=generator), torch.full((count,), 1.0),
            torch.randn((count, 1, 3), generator=generator), torch.full((count,), 2.0),
        ),
        torch.arange(count),
    )  # fmt: skip
    return state


def lengths(state: MapState) -> set[int]:
    sizes = {len(getattr(state.splats, name)) for name in PARAMETERS}
    sizes |= {len(moment) for moments in (state.first, state.second) for moment in moments.values()}
    return sizes | {len(x) for x in (state.steps, state.anchors, state.means2d_gradient, state.means2d_views)}


def test_small_splats_with_a_large_gradient_are_cloned_large_ones_split() -> None:
    state = state_of(10)
    config = DensityControlConfig(gradient=1.0, split_scale=0.01, prune_opacity=0.05)
    with torch.no_grad():
        state.splats.log_scales[4] = math.log(0.1)
        state.splats.opacity_logits[9] = -6.0
    state.means2d_views += 2.0
    state.means2d_gradient[[3, 4, 9]] = 3.0
    change = control(state, config, 1.0, torch.Generator().manual_seed(0))
    assert (change.cloned, change.split, change.pruned) == (1, 1, 1)
    assert lengths(state) == {10 - 1 + 1 + 1}
    assert sorted(state.anchors.tolist()) == [0, 1, 2, 3, 3, 4, 4, 5, 6, 7, 8]
    halves = state.splats.log_scales[state.anchors == 4]
    torch.testing.assert_close(halves, torch.full((2, 3), math.log(0.1 / 1.6)))
    assert not state.means2d_gradient.any()


def test_growth_stops_at_the_limit_with_the_worst_first() -> None:
    state = state_of(10)
    state.means2d_views += 1.0
    state.means2d_gradient += torch.arange(10) + 1.0
    change = control(state, DensityControlConfig(gradient=0.5, max_splats=13), 1.0, torch.Generator())
    assert change.cloned == 3
    assert sorted(state.anchors.tolist())[-6:] == [7, 7, 8, 8, 9, 9]


def test_none_leaves_everything_alone() -> None:
    state = state_of(5)
    before = state.splats.opacity_logits.clone()
    state.means2d_views += 1.0
    state.means2d_gradient += 1.0
    control(state, DensityControlConfig(mode="none"), 1.0, torch.Generator())
    assert torch.equal(before, state.splats.opacity_logits)


@pytest.mark.parametrize(("opacity", "left"), [(0.0, 3), (0.5, 1), (1.0, 0)])
def test_an_opacity_of_0_removes_none_and_one_of_1_all(opacity: float, left: int) -> None:
    state = state_of(3)
    with torch.no_grad():
        state.splats.opacity_logits[:] = torch.logit(torch.tensor([0.1, 0.4, 0.9]))
    assert int((~removable(state, DensityControlConfig(prune_opacity=opacity))).sum()) == left


def test_what_is_no_opacity_and_no_number_of_iterations_is_refused() -> None:
    with pytest.raises(ValueError, match="from 0 to 1"):
        DensityControlConfig(prune_opacity=1.5)
    with pytest.raises(ValueError, match=r"mapper\.density_control\.every=0: .* mode=none"):
        DensityControlConfig(every=0)
    with pytest.raises(ValueError, match=r"mapper\.window=0: .* 1 at least"):
        MapperConfig(window=0)
