"""The depth benchmark's own logic: scores, fronts, variants, and what is not scored."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.depth import failures, tracked
from bench.depth.__main__ import LARGE, SECTIONS, SMALL
from bench.depth.calibration import fit, reliability
from bench.depth.curves import Point, settings
from bench.depth.data import Scene, coarse_grid, without_ragged_edges
from bench.depth.parts import part_variants, skip_variants, variant_rows
from bench.depth.run import Run, scaled_to, score, surest
from mvsgs_core.fusion.fusion import FusedDepth, FusionConfig
from mvsgs_core.mvs.cascade import CascadeConfig


def scene(truth: np.ndarray) -> Scene:
    return Scene("made up", [], [], [truth, None], 0.05)


def test_scores_count_what_is_kept_and_what_is_right() -> None:
    truth = np.full((2, 5), 2.0, np.float32)
    truth[0, 0] = 0.0  # unknown: not scored
    depth = truth.copy()
    depth[1] = [2.05, 2.2, 3.0, 0.0, 0.0]
    found = score([depth, depth], scene(truth))
    assert found.completeness == pytest.approx(7 / 9)
    assert found.inliers == pytest.approx(5 / 7)
    assert found.relative_error == pytest.approx((0.025 + 0.1 + 0.5) / 7)
    assert score([3 * depth, depth], scene(truth), align=True).inliers == found.inliers
    assert score([np.zeros_like(depth), depth], scene(truth)).completeness == 0


def test_the_surest_are_those_of_the_highest_confidence_among_the_kept() -> None:
    truth = np.ones((10, 10), np.float32)
    confidence = np.arange(100, dtype=np.float32).reshape(10, 10) / 100
    depth = np.where(confidence < 0.9, truth, 0)  # the surest tenth was rejected
    fused = FusedDepth(None, depth, truth, confidence, np.zeros((10, 10, 3)), np.ones((10, 10)))  # type: ignore[arg-type]
    chosen = surest(Run([], [fused, fused], 0.0, 0.0), scene(truth), 0.5)[0]
    np.testing.assert_array_equal(chosen > 0, (confidence >= 0.4) & (confidence < 0.9))


def test_a_map_is_scaled_by_its_median_ratio() -> None:
    truth = np.array([[1.0, 2.0, 4.0, 0.0]], np.float32)
    depth = np.array([[0.5, 1.0, 2.0, 7.0]], np.float32)
    np.testing.assert_allclose(scaled_to(depth, truth)[truth > 0], truth[truth > 0])
    assert not scaled_to(np.zeros_like(depth), truth).any()


def test_wrong_depths_along_edges_are_not_scored_but_edges_are() -> None:
    depth = np.full((40, 40), 5.0, np.float32)
    depth[:, 20:] = 2.0
    depth[:, 19] = 0.3  # a line of nonsense
    depth[30:, :10] = 0.009
    clean = without_ragged_edges(depth)
    assert not clean[:30, 19].any()
    assert not clean[33:, :8].any()
    assert (clean[:25, 2:18] == 5.0).all()
    assert (clean[:25, 22:] == 2.0).all()


def test_the_front() -> None:
    good, slow, other = (Point("c", "p", s, i, c) for s, i, c in ((1.0, 0.9, 0.7), (2.0, 0.9, 0.6), (0.5, 0.8, 0.7)))
    assert good.beats(slow)
    assert not slow.beats(good)
    assert not good.beats(other)
    assert not other.beats(good)
    assert not good.beats(good)
    assert good.right == pytest.approx(0.63)


def test_every_variant_and_point_changes_something() -> None:
    plain = (CascadeConfig(area=SMALL), FusionConfig())
    for variant in (*part_variants(SMALL).values(), *skip_variants(SMALL).values()):
        assert variant != plain
    for points in settings(SMALL).values():
        assert all(point != plain[0] for point in points.values())


def test_reliability_of_honest_and_of_boastful_confidences() -> None:
    rng = np.random.default_rng(0)
    probability = rng.random(20000)
    honest, curve = reliability(probability, rng.random(20000) < probability)
    boastful, _ = reliability(probability, rng.random(20000) < 0.5 * probability)
    assert honest < 0.03
    assert boastful > 0.2
    assert sum(fraction for *_, fraction in curve) == pytest.approx(1.0)


def test_the_simulated_grid_is_sparse_noisy_and_partly_wrong() -> None:
    grid, weight = coarse_grid(np.full((240, 320), 2.0, np.float32), seed=1)
    known = grid[grid > 0]
    assert np.array_equal(weight > 0, grid > 0)
    assert 0.4 < len(known) / grid.size < 0.6
    assert np.median(known) == pytest.approx(0.5, rel=0.03)
    assert 0.0 < np.mean(np.abs(known - 0.5) > 0.25) < 0.06


def test_sections_have_names() -> None:
    known = {"quality", "tracked", "oracle", "baselines", "photos", "skips", "curves", "failures", "calibration"}
    assert known <= set(SECTIONS)


def test_a_fit_finds_the_weights_counts_scenes_alike_and_keeps_what_is_given() -> None:
    rng = np.random.default_rng(0)
    truth = np.array([0.5, 1.5, -1.0])

    def sampled(count: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = np.concatenate([np.ones((count, 1)), rng.normal(size=(count, 2))], axis=1)
        return x, rng.random(count) < 1.0 / (1.0 + np.exp(-x @ weights))

    scene = sampled(40000, truth)
    np.testing.assert_allclose(fit([scene], ridge=0.0), truth, atol=0.06)
    one = fit([sampled(1000, truth), sampled(40000, -truth)], ridge=0.0)
    assert np.abs(one).max() < 0.2  # neither outvotes the other
    given = fit([scene], {2: 0.25})
    assert given[2] == 0.25
    assert given[1] > 1.0


def test_the_default_runs_in_turns_with_its_variants(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that gets faster from run to run shows no gain of what runs later."""
    seconds = iter((10.0, 9.0, 8.0, 7.0, 3.0, 6.0))
    ran: list[CascadeConfig] = []

    def run(views: object, cascade: CascadeConfig, fusion: FusionConfig) -> Run:
        ran.append(cascade)
        return Run([], [], 0.0, 0.0, next(seconds))

    def figures(scene: Scene, found: Run, align: bool) -> dict[str, tuple[float, str]]:
        return {"processor time": (1000 * found.processor_seconds, "ms")}

    monkeypatch.setattr("bench.depth.parts.run", run)
    monkeypatch.setattr("bench.depth.parts._figures", figures)
    default, other = CascadeConfig(area=1), CascadeConfig(area=2)
    made = variant_rows("parts", scene(np.ones((2, 2), np.float32)), (default, FusionConfig()), {
        name: (other, FusionConfig()) for name in ("a", "b", "c")
    }, align=False)  # fmt: skip
    assert [config.area for config in ran] == [1, 2, 1, 2, 2, 1]
    rows = {row.name.removeprefix("parts, made up: "): row for row in made if "time" in row.name}
    assert (rows["default: processor time"].value, rows["default: processor time"].spread) == (8000.0, 2000.0)
    changes = [rows[f"{name}: processor time, change"].value for name in "abc"]
    assert changes == ["~ +1e+03", "~ -1e+03", "-5e+03"]


@pytest.mark.parametrize(("name", "sizes"), [("room", [(240, 320), (384, 512)]), ("redkitchen", [None])])
def test_a_rendered_room_is_tracked_at_the_size_of_its_depth_maps(
    name: str, sizes: list[tuple[int, int] | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A real sequence, which has a size of its own, once."""
    read: list[tuple[int, int] | None] = []

    def nothing(dataset: str, **options: Any) -> Iterator[None]:
        read.append(options.get("size"))
        return iter(())

    monkeypatch.setattr(tracked, "open_dataset", nothing)
    tracked._track.cache_clear()
    monkeypatch.setattr(tracked.Collected, "views", lambda *_: [])
    monkeypatch.setattr(tracked.Collected, "take", lambda self, _: self.keyframes.update({0: None}))
    for area in (SMALL, LARGE):
        with pytest.raises(ValueError, match="need at least one array"):
            tracked.load_tracked(name, area)
    tracked._track.cache_clear()
    assert read == sizes


def test_a_filter_that_keeps_nothing_has_no_outliers_and_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = np.ones((2, 5), np.float32)
    nothing = SimpleNamespace(depth=np.zeros_like(truth), counts={"pixels": 10.0})
    monkeypatch.setattr(
        failures, "FAILURES", {"exposure change": lambda room: room, failures.NOTHING: lambda room: room}
    )
    monkeypatch.setattr(failures, "load_scene", lambda *_, **__: scene(truth))
    monkeypatch.setattr(failures, "run", lambda *_: Run([], [nothing, nothing], 0.0, 0.0))
    met = {row.name: row.met for row in failures.failure_rows(SMALL, None)}
    assert met["exposure change: outliers of kept"] is True
    assert met["exposure change: kept"] is False
    assert met[f"{failures.NOTHING}: kept"] is None
