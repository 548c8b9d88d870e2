"""What is out of a setting's range is refused before a process starts, in words that name it; its ends are not."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from launch.checks import check
from launch.compose import compose
from launch.refusal import GraphError
from mvsgs_core.setting_ranges import above, at_least, within

NOTHING = float("nan")


def refusal(*words: str) -> str:
    """What the launcher says of a command line; empty where it would run."""
    try:
        check(compose(["dataset=synthetic", *words]))
    except GraphError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("seed=-1", "must be from 0 to 4294967295"),
        ("seed=4294967296", "must be from 0 to 4294967295"),
        ("buffer=0", "must be 1 or more"),
        ("mapper.seed=-1", "must be from 0 to 4294967295"),
        ("mapper.iterations=-1", "must be 0 or more"),
        ("mapper.refinement=-1", "must be 0 or more"),
        ("mapper.max_pixels=0", "must be 1 or more"),
        ("mapper.max_keyframes=0", "must be 1 or more"),
        ("mapper.images_in_memory=-1", "must be 0 or more"),
        ("mapper.sh_degree=4", "must be from 0 to 3"),
        ("mapper.sh_degree=-1", "must be from 0 to 3"),
        ("mapper.share=0.0", "of a core's time, above 0 and at most 1"),
        ("mapper.share=nan", "not a number, must be float"),
        ("mapper.device=gpu", "must be auto, cpu, cuda or cuda:<number>"),
        ("mapper.device=torch", "must be auto, cpu or cuda:<number>"),
        ("mapper.refine.overlap=1.5", "must be from 0 to 1"),
        ("mvs.lag=-1", "must be 0 or more"),
        ("mvs.window=-1", "must be 0 or more"),
        ("mvs.area=0", "must be 1 or more"),
        ("mvs.share=1.5", "of a core's time, above 0 and at most 1"),
        ("mvs.efforts=[4]", "some of 0: full, 1: "),
        ("mvs.efforts=[]", "some of 0: full, 1: "),
        ("mvs.area=-1 mvs=coarse", "must be 1 or more"),
        ("mvs.network_area=0 mvs=itermvs", "must be 1 or more"),
        ("mvs.efforts=[2] mvs=itermvs mvs.weights=random", "some of 0: full, 1: "),
        ("depth_fusion.lag=-1", "must be 0 or more"),
        ("depth_fusion.neighbors=-1", "must be 0 or more"),
        ("depth_fusion.share=nan", "not a number, must be float"),
        ("depth_fusion.efforts=[3]", "some of 0: full, 1: two neighbors, 2: no neighbor"),
        ("depth_fusion.relative=-1.0", "must be 0 or more"),
        ("mapper.preview_period=-1.0", "must be 0 or more"),
        ("mapper.checkpoint=-1.0", "must be 0 or more"),
        ("mapper.training.pose_visits=-1", "must be 0 or more"),
        ("mapper.training.loss_weights.l1=-1.0", "must be 0 or more"),
        ("mapper.convergence.keep=2.0", "must be from 0 to 1"),
        ("mapper.optimizer.means=-1.0", "must be 0 or more"),
        ("mapper.insertion.flatten=0.0", "must be above 0"),
        ("mapper.density_control.max_splats=0", "must be 1 or more"),
        ("mvs.neighbors.turn=0.0", "must be above 0"),
        ("mvs.ranges.percentile=60.0", "must be from 0 to 50"),
        ("mvs.stages=[]", "must have one stage at least"),
        ("mvs.cost.top_k=0", "must be 1 or more"),
        ("mvs.smoothing.temperature=0.0", "must be above 0"),
        ("mvs.pruning.cell_percentile=101.0", "must be from 0 to 50"),
        ("mvs.depth_edges.radius=17", "must be from 0 to 16"),
        ("viewer.max_splats=-1 viewer=viser", "must be 1 or more"),
        ("tracker.area=1", "must be 1024 or more"),
        ("tracker.area=-1 tracker=photographs", "must be 1 or more"),
        ("tracker.flow=nonsense", "must be one of lucas_kanade, dis, features, raft_small, or module:Class"),
        ("tracker.flow=nonsense tracker=ground_truth", "must be one of lucas_kanade, dis, features, raft_small"),
        ("tracker.flow=nowhere:Flow", "or module:Class; No module named 'nowhere'"),
        ("tracker.flow=json:Flow", "or module:Class; there is no 'Flow' in json"),
        ("tracker.device=gpu", "must be auto, cpu, cuda or cuda:<number>"),
        ("tracker.min_texture=nan", "not a number, must be float"),
        ("tracker.min_texture=2.0", "must be from 0 to 1"),
        ("tracker.tolerance=-1.0", "must be 0 or more"),
        ("tracker.local_map.recent=0", "must be 1 or more"),
        ("tracker.local_map.window=-1", "must be 2 or more"),
        ("tracker.local_map.steps=-1", "must be 0 or more"),
        ("tracker.local_map.robust_scale=0.0", "must be above 0"),
        ("tracker.local_map.window=1 tracker=ground_truth", "must be 2 or more"),
        ("tracker.initialization.patience=0", "must be 1 or more"),
        ("tracker.initialization.forced.min_parallax=-1.0", "must be 0 or more"),
        ("tracker.keyframe_choice.max_flow=-1.0", "must be 0 or more"),
        ("tracker.front_end.lost_inliers=1.5", "must be from 0 to 1"),
        ("tracker.covisibility.max_candidates=-1", "must be 0 or more"),
        ("tracker.loop.min_gap=-1", "must be 0 or more"),
        ("tracker.loop.criteria.min_inliers=0.0", "must be above 0"),
        ("tracker.relocalization.patience=0", "must be 1 or more"),
        ("tracker.recovery.max_images=-1", "must be 0 or more"),
        ("tracker.back_end.max_keyframes=1", "must be 2 or more"),
        ("tracker.focal.probe=1.0", "must be above 0 and below 1"),
        ("mapper.optimizer.means=inf", "not finite, must be float"),
        ("mapper.iterations=100000000000", "beyond 4294967295, must be int or null"),
        ("mvs.threads=2000", "must be 1 or more, at most 1024, or null"),
        ("depth_fusion.confidence=inf", "not finite, must be float"),
        ("depth_fusion.confidence=1.5", "must be from 0 to 1"),
    ],
)
def test_a_setting_out_of_its_range_is_named(words: str, wanted: str) -> None:
    setting = words.split()[0]
    said = refusal(*words.split())
    assert said.startswith(f"{setting}: "), said
    assert wanted in said


@pytest.mark.parametrize(
    "words",
    [
        "seed=4294967295 buffer=1",
        "mapper.iterations=0 mapper.refinement=0 mapper.max_pixels=1 mapper.sh_degree=3 mapper.share=1",
        "mvs.lag=0 mvs.window=0 mvs.area=1 mvs.efforts=[3] mvs.device=torch",
        "depth_fusion.lag=0 depth_fusion.window=0 depth_fusion.neighbors=0 depth_fusion.efforts=[0,2]",
        "tracker.area=1024 tracker.flow=dis tracker.front_end.still_flow=inf",
        "tracker.covisibility.max_flow=0 tracker.recovery.max_images=0 tracker.loop.max_candidates=0 mvs.threads=1024",
        "tracker.back_end.robust_scales=[] tracker.back_end.steps=0",
        "tracker.local_map.window=2 tracker.local_map.steps=0",
        "mapper.insertion.median_errors=inf mapper.seed=4294967295 depth_fusion.confidence=1",
    ],
)
def test_the_ends_of_a_range_belong_to_it(words: str) -> None:
    assert not refusal(*words.split())


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("robust_scales=[1,0]", "robust_scales=(1.0, 0.0): each must be above 0"),
        ("factors=[]", "factors=(): one at least, each above 0"),
        ("bounds=[3,1]", "bounds=(3.0, 1.0): the lower one above 0, and below the upper one"),
    ],
)
def test_a_list_of_settings_is_shown_as_a_whole(words: str, wanted: str) -> None:
    part = "back_end" if words.startswith("robust") else "focal"
    assert refusal(f"tracker.{part}.{words}") == f"tracker.{part}.{wanted}"


def test_a_stage_of_stereo_is_named_by_its_place() -> None:
    stage = "{scale:0,step:0.7,hypotheses:9,radius:2,p1:0.3,p2:2}"
    assert refusal(f"mvs.stages=[{stage}]") == "mvs.stages[0].scale=0: must be 1 or more"


def test_a_negative_seed_of_the_scene_is_refused() -> None:
    assert refusal("dataset.options.seed=-1").endswith("start and seed at least 0")


def test_weights_of_a_flow_are_missed_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", "/nowhere")
    assert refusal("tracker.flow=raft_small").startswith("tracker: no weights of RAFT")


@dataclass
class Given:
    count: int | None = 2
    part: float = 0.5


@pytest.mark.parametrize(("count", "part"), [(2, 0.5), (None, 0.0), (0, 1.0)])
def test_what_is_in_range_or_not_given_passes(count: int | None, part: float) -> None:
    at_least(Given(count, part), count=0)
    above(Given(count, part), count=-1)
    within(Given(count, part), part=(0, 1))


@pytest.mark.parametrize("value", [-1, NOTHING])
def test_what_is_below_or_no_number_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match=f"^count={value}: must be 0 or more$"):
        at_least(SimpleNamespace(count=value), count=0)
    with pytest.raises(ValueError, match=f"^count={value}: must be above -1$"):
        above(SimpleNamespace(count=value), count=-1)
    with pytest.raises(ValueError, match=f"^part={value}: must be from 0 to 1$"):
        within(SimpleNamespace(part=value), part=(0, 1))
