"""What a map does without: what a splat's removal costs, by one render without it, and what is taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvsgs_core.mapping import pruning
from mvsgs_core.mapping.keyframes import RGBDKeyframe, TrainingView, training_view
from mvsgs_core.mapping.map_state import PARAMETERS, MapState
from mvsgs_core.mapping.pruning import HIDDEN, OPAQUE, prune, removal_cost
from mvsgs_core.rasterizer.rasterize import Render, rasterize
from mvsgs_core.rasterizer.splats import Splats
from tests.support.rasterizer_scenes import intrinsics, random_splats
from tests.support.small_maps import CONFIG, RARE, mapped, score
from tests.support.tiny_scene import pose_on_arc, rgbd_keyframe

SIZE = (40, 56)


def state_of(splats: Splats, anchors: list[int] | None = None) -> MapState:
    state = MapState(splats.sh.shape[1], torch.device("cpu"))
    count = len(splats.means)
    state.append(splats, torch.zeros(count, dtype=torch.int64) if anchors is None else torch.tensor(anchors))
    return state


def view_of(index: int, image: np.ndarray, shift: float = 0.0) -> TrainingView:
    pose = np.eye(4)
    pose[0, 3] = shift
    depth = np.ones(SIZE, dtype=np.float32)
    return training_view(RGBDKeyframe(index, image, intrinsics(SIZE), pose, depth), pose, None, torch.device("cpu"))


def photograph(splats: Splats, view: TrainingView) -> Render:
    return rasterize(splats, view.refined_from_cam, view.intrinsics, view.size, weights=True, threads=1)


def images(splats: Splats, shifts: tuple[float, ...] = (0.0, 0.1)) -> list[TrainingView]:
    """Views whose images are the splats' own, with noise."""
    noise = np.random.default_rng(0)
    views = []
    for index, shift in enumerate(shifts):
        color = photograph(splats, view_of(index, np.zeros((*SIZE, 3), dtype=np.uint8), shift)).color.detach().numpy()
        color = np.clip(color + noise.normal(0.0, 0.02, color.shape), 0.0, 1.0)
        views.append(view_of(index, np.round(255.0 * color).astype(np.uint8), shift))
    return views


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many passes that the estimates are good to a few percent: all splats of a wall cost the same."""
    monkeypatch.setattr(pruning, "PASSES", 400)


def front(count: int) -> Splats:
    splats = random_splats(count, bases=1)
    splats.opacity_logits.clamp_(max=3.0)
    return splats


@pytest.mark.usefixtures("exact")
def test_an_image_that_shows_a_splat_behind_its_mask_alone_does_not_make_it_cheaper() -> None:
    splats = front(12)
    plain = images(splats, (0.0, 0.0))
    masked = [plain[0], replace(plain[1], valid=torch.zeros(SIZE, dtype=torch.bool))]
    state = state_of(splats)
    (by_one, _), (by_both, _) = (
        removal_cost(state, views, photograph, torch.Generator().manual_seed(0)) for views in ([plain[0]], masked)
    )
    shown = torch.isfinite(by_one)
    assert shown.any()
    # summed over as many images as there are
    torch.testing.assert_close(by_both[shown], 2 * by_one[shown], rtol=0.25, atol=0.02 * float(by_one[shown].max()))


@pytest.mark.usefixtures("exact")
def test_the_cost_is_that_of_a_render_without_the_splat() -> None:
    splats = front(12)
    views = images(splats)
    state = state_of(splats)
    generator = torch.Generator().manual_seed(0)
    cost, squared = removal_cost(state, views, photograph, generator)
    expected, seen, weight = torch.zeros(3, 12, dtype=torch.float64).unbind(0)
    error = 0.0
    for view in views:
        whole = photograph(splats, view)
        error += float(((whole.color - view.target) ** 2).sum())
        seen += whole.visible
        assert whole.weight_max is not None
        weight = torch.maximum(weight, whole.weight_max.double())
        for k in range(12):
            without = {name: getattr(splats, name).clone() for name in PARAMETERS}
            without["opacity_logits"][k] = -30.0
            expected[k] += float(((photograph(Splats(**without), view).color - whole.color) ** 2).sum())
    expected = expected * len(views) / seen.clamp(min=1)
    visible = (seen > 0) & (weight >= HIDDEN * torch.sigmoid(splats.opacity_logits))
    assert 6 < int(visible.sum()) < 12
    assert torch.equal(torch.isinf(cost), ~visible)
    assert squared == pytest.approx(error, rel=1e-5)
    torch.testing.assert_close(cost[visible], expected[visible], rtol=0.25, atol=0.01 * float(expected[visible].max()))


def wall_with(*others: tuple[float, float, float]) -> Splats:
    """A gray wall at depth 2 of 15 x 21 splats that overlap, and gray ones at (depth, opacity, shade)."""
    y, x = torch.meshgrid(torch.linspace(-1.4, 1.4, 15), torch.linspace(-2.0, 2.0, 21), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((315,), 2.0)], dim=1)
    more = torch.tensor([[0.0, 0.0, depth] for depth, _, _ in others]).reshape(-1, 3)
    opacity = torch.tensor([0.9] * 315 + [opacity for _, opacity, _ in others])
    shades = torch.tensor([0.5] * 315 + [shade for _, _, shade in others])
    count = len(opacity)
    return Splats(
        torch.cat([means, more]), torch.full((count, 3), np.log(0.15)),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1), torch.logit(opacity),
        ((shades - 0.5) / 0.28209479177387814)[:, None, None].repeat(1, 1, 3), torch.full((count,), 2.0),
    )  # fmt: skip


@pytest.mark.usefixtures("exact")
def test_one_of_the_walls_own_color_goes_one_of_another_and_one_behind_stay() -> None:
    splats = wall_with((1.9, 0.6, 0.5), (1.8, 0.6, 0.9), (3.0, 0.9, 0.1))
    views = images(splats)
    state = state_of(splats)
    removed = prune(state, views, photograph, 0.01, torch.Generator().manual_seed(0))
    kept = {round(float(z), 3) for z in state.detached().means[:, 2]}
    assert 1.9 not in kept
    assert {1.8, 3.0} <= kept  # the one behind may be all that a view from elsewhere has to show
    assert len(state) == 318 - removed == len(state.anchors) == len(state.first["means"])


def test_a_mask_that_covers_nothing_changes_no_cost() -> None:
    """Not even of a splat that is hidden in one image and shown in the other."""
    splats = wall_with(*[(depth, 0.97, 0.5) for depth in (1.6, 1.7, 1.8, 1.9)], (3.0, 0.9, 0.1))
    splats.log_scales[315:-1] = 0.0  # wide ones before the last
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 5.0
    before, other = images(splats, (0.0, 0.0))
    views = [before, replace(other, local_from_cam=behind)]
    masked = [replace(view, valid=torch.ones(SIZE, dtype=torch.bool)) for view in views]
    (plain, _), (covered, _) = (
        removal_cost(state_of(splats), given, photograph, torch.Generator().manual_seed(0)) for given in (views, masked)
    )
    assert photograph(splats, before).weight_max[-1] == 0
    assert torch.isfinite(plain[-1])
    assert torch.equal(plain, covered)


@pytest.mark.usefixtures("exact")
def test_no_more_goes_than_the_error_allows() -> None:
    """Of splats that lie apart, costs add up; the fainter, the cheaper."""
    y, x = torch.meshgrid(torch.linspace(-1.0, 1.0, 4), torch.linspace(-1.5, 1.5, 6), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((24,), 2.0)], dim=1)
    turns, opacity = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(24, 1), torch.linspace(0.02, 0.9, 24)
    splats = Splats(
        means, torch.full((24, 3), np.log(0.06)), turns, torch.logit(opacity), torch.zeros(24, 1, 3),
        torch.full((24,), 2.0),
    )  # fmt: skip
    views = images(splats)

    def error(state: MapState) -> float:
        return sum(float(((photograph(state.detached(), v).color - v.target) ** 2).sum()) for v in views)

    counts = []
    for fraction in (0.0, 0.5, 3.0):
        state = state_of(splats)
        before = error(state)
        counts.append(prune(state, views, photograph, fraction, torch.Generator().manual_seed(0)))
        assert error(state) <= before * (1.0 + 1.5 * fraction)
        assert counts[-1] == 0 or float(state.detached().opacity_logits.mean()) > float(splats.opacity_logits.mean())
    assert counts[0] == 0 < counts[1] < counts[2] < 24


def test_splats_of_keyframes_without_an_image_stay() -> None:
    splats = wall_with((1.9, 0.6, 0.5))
    views = images(splats)
    state = state_of(splats, [7] * 316)
    assert prune(state, views, photograph, 10.0, torch.Generator().manual_seed(0)) == 0
    assert len(state) == 316


def test_pixels_that_are_left_out_do_not_count() -> None:
    splats = wall_with((1.8, 0.6, 0.9))
    (view, *_) = images(splats)
    view.valid = torch.zeros(SIZE, dtype=torch.bool)
    cost, error = removal_cost(state_of(splats), [view], photograph, torch.Generator().manual_seed(0))
    assert error == 0.0
    assert not cost[torch.isfinite(cost)].any()


def test_what_is_brighter_than_white_is_no_error_where_the_photograph_is_white() -> None:
    splats = wall_with((1.8, 0.6, 0.9))
    (view, *_) = images(splats)

    def exposed(given: Splats, seen: TrainingView) -> Render:
        render = photograph(given, seen)
        render.color = 3.0 * render.color
        return render

    view.image = (255.0 * exposed(splats, view).color.detach().clamp(0.0, 1.0)).round().to(torch.uint8)
    assert (view.image == 255).any()
    _, error = removal_cost(state_of(splats), [view], exposed, torch.Generator().manual_seed(0))
    assert error < view.image.numel() * (0.5 / 255.0) ** 2


def test_an_opaque_splat_is_not_cheap() -> None:
    """Beyond the greatest alpha the color no longer depends on the opacity: it has no gradient there."""
    splats = wall_with((1.8, 0.999999, 0.9))
    almost = wall_with((1.8, OPAQUE, 0.9))
    costs = [
        removal_cost(state_of(each), images(each), photograph, torch.Generator().manual_seed(0))[0][-1]
        for each in (splats, almost)
    ]
    assert float(costs[0]) == pytest.approx(float(costs[1]), rel=0.05)
    assert float(costs[0]) > 1.0


def test_the_refinement_thins_the_map_and_does_not_harm_it() -> None:
    views = [rgbd_keyframe(5 * k, pose_on_arc(t)) for k, t in enumerate((0.0, 0.33, 0.66, 1.0))]
    unseen = rgbd_keyframe(99, pose_on_arc(0.5))
    thinned = mapped(views)
    all_there = mapped(views, replace(CONFIG, density_control=replace(RARE, needless=0.0)))
    assert thinned.log.counts["needless"] > 0.01 * len(all_there.state)
    assert len(thinned.state) == len(all_there.state) - thinned.log.counts["needless"]
    assert score(thinned, unseen) > score(all_there, unseen) - 0.1
