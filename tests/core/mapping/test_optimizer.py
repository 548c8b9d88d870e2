"""Selective Adam: kernel against its PyTorch twin and against torch.optim.Adam; bad gradients; bounds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from mvsgs_core.mapping import optimizer
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.mapping.optimizer import OptimizerConfig, groups, splat_step, step, step_reference
from mvsgs_core.rasterizer.rasterize import rasterize
from mvsgs_core.rasterizer.splats import Splats

RATES = OptimizerConfig()


def random_state(count: int, seed: int = 0, bases: int = 4) -> MapState:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    state = MapState(bases, torch.device("cpu"))
    state.append(
        Splats(draw(count, 3), draw(count, 3) - 4, draw(count, 4), draw(count), draw(count, bases, 3), draw(count)),
        torch.arange(count),
    )
    state.steps = torch.randint(0, 900, (count,), generator=generator, dtype=torch.int32)
    return state


def set_gradients(state: MapState, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for name in PARAMETERS:
        parameter = getattr(state.splats, name)
        parameter.grad = torch.randn(parameter.shape, generator=generator) * 1e-4


def all_groups(train_betas: bool = True) -> list[optimizer.Group]:
    return groups(RATES, 2.0, 0.7, train_betas, "exact")


def test_kernel_equals_its_twin_over_many_steps() -> None:
    kernel, twin = random_state(700), random_state(700)
    for iteration in range(20):
        visible = torch.rand(700, generator=torch.Generator().manual_seed(iteration)) < 0.6
        for state in (kernel, twin):
            set_gradients(state, iteration)
        assert step(kernel, visible, all_groups(), RATES.decay_steps, threads=2) == 0
        assert step_reference(twin, visible, all_groups(), RATES.decay_steps) == 0
    assert torch.equal(kernel.steps, twin.steps)
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(kernel.splats, name), getattr(twin.splats, name), rtol=1e-4, atol=2e-5)
        torch.testing.assert_close(kernel.second[name], twin.second[name], rtol=1e-4, atol=1e-20)


class WideFloat64(TorchDispatchMode):
    """The operations that make a float64 for each value of a splat, not one for the splat."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count, self.found = count, set[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor) and result.dtype == torch.float64 and result.numel() > self.count:
            self.found.add(func._schema.name)
        return result


def test_a_gpu_steps_in_float32() -> None:
    state = random_state(50)
    set_gradients(state, 1)
    with WideFloat64(len(state)) as watched:
        step_reference(state, torch.ones(50, dtype=torch.bool), all_groups(), RATES.decay_steps)
    assert not watched.found


@pytest.mark.parametrize("fraction", [0.1, 0.6, 1.0])
@pytest.mark.parametrize("bases", [1, 16])
def test_few_and_many_of_a_block_with_bad_values_among_them(fraction: float, bases: int) -> None:
    kernel, twin = random_state(300, bases=bases), random_state(300, bases=bases)
    visible = torch.rand(300, generator=torch.Generator().manual_seed(3)) < fraction
    visible[[7, 130]] = True
    for state in (kernel, twin):
        set_gradients(state, 1)
        state.splats.means.grad[7, 1] = float("nan")  # type: ignore[index]
        state.splats.sh.grad[~visible] = float("inf")  # type: ignore[index]  # nobody looks at these
        state.second["quaternions"][130, 1] = float("inf")
    refused = step(kernel, visible, all_groups(), 5000, threads=1)
    assert refused == step_reference(twin, visible, all_groups(), 5000) == 2
    assert torch.equal(kernel.steps, twin.steps)
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(kernel.splats, name), getattr(twin.splats, name), rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(kernel.first[name], twin.first[name], rtol=1e-4, atol=1e-12)


@pytest.mark.slow
def test_a_fresh_splat_seen_every_time_follows_torch_adam() -> None:
    state = random_state(50)
    state.steps.zero_()
    group = [g for g in all_groups() if g.name == "log_scales"]
    oracle = state.splats.log_scales.detach().clone().requires_grad_(True)
    adam = torch.optim.Adam([oracle], lr=group[0].rate, eps=optimizer.EPSILON)
    for iteration in range(10):
        set_gradients(state, iteration)
        oracle.grad = state.splats.log_scales.grad.clone()
        adam.step()
        step(state, torch.ones(50, dtype=torch.bool), group, RATES.decay_steps, threads=1)
    torch.testing.assert_close(state.splats.log_scales.detach(), oracle.detach(), rtol=1e-5, atol=1e-6)


def test_what_was_not_seen_stays_as_it_was() -> None:
    state, before = random_state(100), random_state(100)
    set_gradients(state, 1)
    visible = torch.zeros(100, dtype=torch.bool)
    visible[::2] = True
    step(state, visible, all_groups(), RATES.decay_steps)
    for name in PARAMETERS:
        now, then = getattr(state.splats, name), getattr(before.splats, name)
        assert torch.equal(now[1::2], then[1::2])
        assert not torch.equal(now[::2], then[::2])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e38])
@pytest.mark.parametrize("run", [step, step_reference])
def test_a_bad_gradient_is_refused_for_that_splat_only(bad: float, run) -> None:  # type: ignore[no-untyped-def]
    state, before = random_state(40), random_state(40)
    set_gradients(state, 1)
    state.splats.sh.grad[7, 2, 1] = bad
    refused = run(state, torch.ones(40, dtype=torch.bool), all_groups(), RATES.decay_steps)
    assert refused == 1
    for name in PARAMETERS:
        assert torch.isfinite(getattr(state.splats, name)).all()
        assert torch.isfinite(state.second[name]).all()
    assert torch.equal(state.splats.sh[7], before.splats.sh[7])
    assert not torch.equal(state.splats.sh[8], before.splats.sh[8])


def test_wild_rates_stay_inside_the_bounds() -> None:
    state = random_state(30)
    wild = groups(
        OptimizerConfig(means=1e4, log_scales=50.0, opacity_logits=1e3, sh=1e3, betas=1e3), 1.0, 1.0, True, "exact"
    )
    for iteration in range(30):
        set_gradients(state, iteration)
        step(state, torch.ones(30, dtype=torch.bool), wild, 100)
    for group in wild:
        values = getattr(state.splats, group.name)
        assert torch.isfinite(values).all()
        assert values.min() >= group.low
        assert values.max() <= group.high


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.inf, math.nan])
def test_a_widest_splat_that_cannot_be_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match=r"mapper.optimizer.max_scale=.*median depths"):
        OptimizerConfig(max_scale=wrong)


@pytest.mark.parametrize("wrong", [0.0, -0.5, 1.1, math.nan])
def test_a_part_of_the_widest_that_is_none_is_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match=r"mapper.optimizer.max_scale_in_stream=.*a part of max_scale"):
        OptimizerConfig(max_scale_in_stream=wrong)


@pytest.mark.parametrize("run", [step, step_reference])
@pytest.mark.parametrize(("new", "widest"), [(0.03, 0.1), (0.2, 0.2), (1.0, 0.3), (None, 0.3)])
def test_no_splat_grows_beyond_the_widest(run: Any, new: float | None, widest: float) -> None:
    state = random_state(30)
    with torch.no_grad():
        state.splats.log_scales.sub_(2.0)
    rates = OptimizerConfig(max_scale=0.3, max_scale_in_stream=1 / 3)
    for _ in range(80):
        grow(state)
        run(state, torch.ones(30, dtype=torch.bool), groups(rates, 2.0, 1.0, True, "exact", widest_new=new), 100)
    torch.testing.assert_close(state.splats.log_scales.exp(), torch.full((30, 3), widest * 2.0))


@pytest.mark.parametrize("run", [step, step_reference])
def test_a_splat_that_a_refinement_made_wide_stays_so_in_the_stream_and_may_shrink(run: Any) -> None:
    state = random_state(30)
    with torch.no_grad():
        state.splats.log_scales.fill_(math.log(0.25 * 2.0))
    rates = OptimizerConfig(max_scale=0.3, max_scale_in_stream=0.1)
    for _ in range(3):
        grow(state)
        run(state, torch.ones(30, dtype=torch.bool), groups(rates, 2.0, 1.0, True, "exact", widest_new=0.03), 100)
    torch.testing.assert_close(state.splats.log_scales.exp(), torch.full((30, 3), 0.25 * 2.0))
    for _ in range(20):  # the first of them still against the momentum
        grow(state, -1.0)
        run(state, torch.ones(30, dtype=torch.bool), groups(rates, 2.0, 1.0, True, "exact", widest_new=0.03), 100)
    assert state.splats.log_scales.exp().max() < 0.2 * 2.0


def grow(state: MapState, sign: float = 1.0) -> None:
    """Gradients that make all splats wider, and all else larger."""
    for name in PARAMETERS:
        getattr(state.splats, name).grad = torch.full_like(getattr(state.splats, name), -1e-4 * sign)


def test_threads_do_not_change_the_result() -> None:
    one, two = random_state(2000), random_state(2000)
    for state, threads in ((one, 1), (two, 2)):
        set_gradients(state, 3)
        step(state, torch.ones(2000, dtype=torch.bool), all_groups(), RATES.decay_steps, threads=threads)
    for name in PARAMETERS:
        assert torch.equal(getattr(one.splats, name), getattr(two.splats, name))


@pytest.mark.parametrize(("kernel", "bases", "threads"), [("gaussian", 1, 1), ("exact", 4, 2)])
def test_a_step_in_the_backward_pass_is_the_step_after_it_to_the_bit(kernel: str, bases: int, threads: int) -> None:
    apart, fused = random_state(1500, bases=bases), random_state(1500, bases=bases)
    chosen = groups(RATES, 2.0, 0.7, kernel == "exact", kernel)
    options: Any = {"kernel": kernel, "backend": "cpu", "threads": threads}
    camera = np.eye(4), np.array([30.0, 30.0, 23.5, 15.5]), (32, 48)
    for state in (apart, fused):
        with torch.no_grad():
            state.splats.means[:, 2] += 1.5  # some before the camera, some behind, some beside the image
            state.splats.betas.abs_().add_(0.5)
        state.second["sh"][7] = float("inf")
    for iteration in range(3):
        weight = torch.randn((*camera[2], 3), generator=torch.Generator().manual_seed(iteration))
        render = rasterize(apart.splats, *camera, **options)
        (render.color * weight).sum().backward()
        assert render.means2d.grad is not None
        apart.accumulate_means2d(render.means2d.grad.norm(dim=1).nan_to_num_(0.0, 0.0, 0.0), render.visible)
        refused = step(apart, render.visible, chosen, RATES.decay_steps, threads)
        within = splat_step(fused, chosen, RATES.decay_steps)
        render = rasterize(fused.splats, *camera, **options, step=within)
        (render.color * weight).sum().backward()
        assert fused.splats.means.grad is None
        assert within.refused == refused == int(render.visible[7])
    assert 500 < int(render.visible.sum()) < 1400
    assert bool(render.visible[7])
    for name, value in apart.tensors().items():
        assert torch.equal(fused.tensors()[name], value), name


def test_a_kernel_that_renders_other_splats_is_not_stepped() -> None:
    state = random_state(5)
    within = splat_step(state, all_groups(), RATES.decay_steps)
    with pytest.raises(ValueError, match="ges_scale"):
        rasterize(state.splats, np.eye(4), np.ones(4), (8, 8), kernel="ges_scale", step=within)
    with pytest.raises(ValueError, match="reference"):
        rasterize(state.splats, np.eye(4), np.ones(4), (8, 8), backend="reference", step=within)
