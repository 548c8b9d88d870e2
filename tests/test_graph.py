"""Composition: what a configuration becomes, what is refused and with which words, and the inline run."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from launch.compose import CONF, compose, defaults_of
from launch.graph import Edge, Graph
from launch.inline import run_inline
from launch.placement import niceness, own_threads, thread_plan
from launch.refusal import GraphError
from launch.specs import addresses, spec
from msgs import Frame, GroundTruth, Keyframe, Poses
from mvsgs_core.setting_ranges import LARGEST
from nodes.parameters import ParameterError, convert
from tests.support.fake_graph.stages import Relay, Sink

FAKE = Path(__file__).parent / "support" / "fake_graph" / "conf"
STAGES = "tests.support.fake_graph.stages"


def fake(*overrides: str) -> Graph:
    return compose(overrides, FAKE)


def test_edges_come_from_reads_and_senders_precede_readers() -> None:
    graph = fake()
    assert list(graph.slots) == ["source", "relay", "sink"]
    assert set(graph.edges) == {
        Edge(Frame, "source", "relay", False),
        Edge(GroundTruth, "source", "sink", False),
        Edge(Keyframe, "relay", "sink", False),
        Edge(Poses, "relay", "sink", False),
    }
    assert graph.sources == ["source"]


def test_parameters_are_the_choice_files_then_the_command_lines_then_the_defaults() -> None:
    slot = fake("relay.stride=7", "relay.gain=2").slots["relay"]
    assert slot.config == {
        "stride": 7, "gain": 2.0, "fail_at": None, "kill_at": None, "hang_at": None, "seconds": 0.0,
        "long_at": None, "long": 0.0, "tell_at": None, "how": "asleep", "says": None, "nothing": None,
    }  # fmt: skip
    assert isinstance(slot.config["gain"], float)


def test_a_data_set_s_options_are_its_own_and_all_in_the_configuration() -> None:
    given = compose(["dataset.options.frames=33"]).slots["dataset"].config["options"]
    assert given["frames"] == 33
    assert (given["scene"], given["rest_start"]) == ("room", 40)
    assert compose(["dataset=tum"]).slots["dataset"].config["options"] == {
        "camera": None, "crop": None, "max_difference": 0.02,
    }  # fmt: skip
    with pytest.raises(GraphError, match=r"dataset.options.frames: there is no such key; there are: crop, camera"):
        compose(["dataset=tum", "dataset.options.frames=3"])
    with pytest.raises(GraphError, match=r"did you mean camera\?"):
        compose(["dataset=tum", "dataset.options.camra=freiburg1"])
    with pytest.raises(GraphError, match="dataset: no dataset 'tun'"):
        compose(["dataset=tum", "dataset.name=tun"])


def test_output_and_device_reach_the_nodes_that_have_them(tmp_path: Path) -> None:
    graph = fake(f"output={tmp_path}", "device=cpu", "source.device=auto")
    assert graph.slots["sink"].config["output"] == str(tmp_path)
    assert graph.slots["source"].config["device"] == "cpu"
    assert fake("source.device=cuda:3").slots["source"].config["device"] == "cuda:3"
    assert Path(fake().settings.output).parent == Path.cwd() / "runs"


def test_best_effort_on_either_side() -> None:
    def best_effort(*overrides: str) -> set[tuple[str, bool]]:
        return {(edge.message.__name__, edge.best_effort) for edge in fake(*overrides).edges}

    assert ("Frame", True) in best_effort("relay.reads.Frame=source?")
    assert ("Frame", True) in best_effort("source=live")
    assert ("GroundTruth", False) in best_effort("source=live")


def test_real_time_is_one_switch_and_the_default_of_live_sources() -> None:
    plain, paced = compose([]), compose(["realtime=true"])
    live, unhurried = compose(["dataset=camera"]), compose(["dataset=camera", "realtime=false"])
    for graph, realtime in ((plain, False), (paced, True), (live, True), (unhurried, False)):
        assert graph.settings.realtime is graph.resolved["realtime"] is realtime
        for name in ("mvs", "depth_fusion", "mapper"):
            assert graph.slots[name].config["realtime"] is realtime
        assert graph.settings.buffer == (128 if realtime else 4)
    assert paced.slots["dataset"].config["realtime"] is True
    (frames,) = [edge for edge in paced.edges if edge.message is Frame]
    assert frames.best_effort  # as a camera's
    assert [niceness(paced, name) for name in paced.slots] == [0, 0, 4, 8, 12, 12]  # in their order
    assert niceness(compose(["realtime=true", "viewer=viser"]), "viewer") == 15
    assert niceness(compose(["realtime=true", "publisher=ros2"]), "publisher") == 4  # poses, for which a robot waits
    assert {niceness(plain, name) for name in plain.slots} == {0}


REFUSED = [
    (["relya=plain"], "did you mean relay", "slots: source, relay, sink"),
    (["relay=fancy"], "no choice 'fancy'", "there are: plain"),
    (["relay.strid=5"], "did you mean stride", "gain: float = 1.0"),
    (["+relay.strid=5"], "no parameter 'strid'", "stride: int = 1"),
    (["relay.stride=abc"], "relay.stride=abc", "must be int"),
    (["relay.stride=2.5"], "relay.stride=2.5", "must be int"),
    (["source.count=true"], "source.count=True", "must be int"),
    (["source.size=[1,2,3]"], "source.size", "must be [int, int]"),
    (["source.mode=red"], "source.mode=red", "'gray' or 'color'"),
    (["relay.fail_at=x"], "relay.fail_at=x", "must be int or null"),
    (["relay.threads=x"], "relay.threads=x", "must be int or null"),
    (["relay.device=cpu"], "no parameter 'device'", "stride: int"),
    (["buffer=many"], "buffer=many", "must be int"),
    (["supervise.silent=70"], "supervise.silent=70", "below dead=60"),
    (["supervise.slow=1"], "supervise.slow", ""),
    (["transport=udp"], "transport=udp", "'ipc' or 'tcp'"),
    (["device=tpu"], "device=tpu", "auto, cpu, cuda"),
    (["device=cuda:99", "source.device=auto"], "device=cuda:99", "CUDA devices"),
    (["sink.tint=3"], "did you mean sink.labels.tint?", "labels: {tint, shade}"),
    (["sink.labels.color=3"], "sink.labels.color: ", "tint: int = 1"),
    (["sink.labels.shad=3"], "did you mean shade", "shade: float = 0.5"),
    (["sink.labels.tint=x"], "sink.labels.tint=x", "must be int"),
    (["relay._target_=nowhere.Node"], "no module 'nowhere'", "PYTHONPATH"),
    (["relay._target_=Node"], "relay._target_=Node", "module.Class"),
    ([f"relay._target_={STAGES}.Rely"], "did you mean Relay", "has: Source, Relay, Sink"),
    ([f"relay._target_={STAGES}.np"], "is no node", "has: Source"),
    ([f"relay._target_={STAGES}.Bare"], "neither run() nor", ""),
    ([f"relay._target_={STAGES}.Untyped"], "must take one message", ""),
    ([f"relay._target_={STAGES}.Returning"], "Returning.on_frame must yield its messages", "-> Iterator[Keyframe]"),
    ([f"relay._target_={STAGES}.Undecorated"], "Undecorated.Config must be a dataclass", "write @dataclass above it"),
    ([f"relay._target_={STAGES}.Added"], "Added.Config must be a dataclass", "write @dataclass(frozen=True) above it"),
    ([f"relay._target_={STAGES}.Source"], "nobody sends", "yields Frame, GroundTruth"),
    (["relay._target_=null"], "nobody sends tests.support.fake_graph.stages.Sink a Keyframe", "that slot is off"),
    (["~relay.reads"], f"relay: nobody sends {STAGES}.Relay a Frame", "set relay.reads.Frame to"),
    (["relay.reads.Frame=sink"], f"relay: nobody sends {STAGES}.Relay a Frame", "that does: source"),
    (["relay.reads.Frame=camera"], "no such slot", "there are: source, relay, sink"),
    (["relay.reads.Poses=source"], "does not take a Poses", "it takes: Frame"),
    (["relay.reads.Pose=source"], "no such message", "Keyframe"),
    (["source.reads.Frame=relay"], "is a source", "can read nothing"),
    (["nonsense"], "nonsense", "slot=choice"),
]


@pytest.mark.parametrize(("overrides", "what", "valid"), REFUSED, ids=lambda v: v[0] if isinstance(v, list) else "")
def test_refused_before_anything_starts(overrides: list[str], what: str, valid: str) -> None:
    with pytest.raises(GraphError) as refusal:
        fake(*overrides)
    assert what in str(refusal.value)
    assert valid in str(refusal.value)


def test_observers_are_those_declared_and_readers_of_best_effort_edges_only() -> None:
    newest = [f"sink.reads.{name}" for name in ("Keyframe=relay?", "Poses=relay?", "GroundTruth=source?")]
    assert fake().observers == set()
    assert fake("sink.observer=true").observers == {"sink"}
    assert fake(*newest).observers == {"sink"}
    assert fake(*newest[:2]).observers == set()
    assert fake("source=live").observers == set()  # whom the map needs, even if a camera sends it the newest only
    assert fake("sink.observer=true", f"relay._target_={STAGES}.Uncorrected", "source=live").observers == {"sink"}
    assert compose(["viewer=viser", "recorder=mcap"]).observers == {"evaluator", "viewer", "recorder"}
    with pytest.raises(GraphError, match=r"sink reads Keyframe from relay, which may fail alone: set relay.observer"):
        fake("relay.observer=true")


def test_what_an_observer_lacks_it_can_be_left_out_for() -> None:
    with pytest.raises(GraphError, match=r"a GroundTruth: .* \(no slot does; evaluator=off runs without it\)"):
        compose([f"dataset._target_={STAGES}.Sighted"])
    assert compose([f"dataset._target_={STAGES}.Sighted", "evaluator=off"]).sources == ["dataset"]


def test_a_cycle_is_refused_with_its_path() -> None:
    with pytest.raises(GraphError, match=r"a cycle: (relay -> sink -> relay|sink -> relay -> sink)"):
        fake(f"sink._target_={STAGES}.Loop", "relay.reads.Frame=sink")
    with pytest.raises(GraphError, match="a cycle: "):
        fake(f"sink._target_={STAGES}.Loop", "relay.reads.Frame=sink?")


def test_an_inline_run_that_fails_lets_its_nodes_save_what_they_have(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    saved: list[str] = []
    monkeypatch.setattr(Sink, "on_abort", lambda self, reason: saved.append(reason))
    with pytest.raises(ArithmeticError):
        run_inline(fake(f"output={tmp_path}", "relay.fail_at=2"))
    assert saved == ["ArithmeticError: frame 2 cannot be relayed"]


def test_another_target_starts_from_its_own_defaults() -> None:
    graph = fake(f"relay._target_={STAGES}.Uncorrected", "relay.every=3", "device=cpu")
    assert graph.slots["relay"].config == {"device": "cpu", "every": 3}  # and no `stride` of the old choice
    assert Poses not in {edge.message for edge in graph.edges}
    assert any("Poses" in warning and "Uncorrected" in warning for warning in graph.warnings)
    with pytest.raises(GraphError, match="no parameter 'stride'"):
        fake(f"relay._target_={STAGES}.Uncorrected", "relay.stride=3")


def test_corrections_are_not_lost_in_silence() -> None:
    """Poses may be missing where no tracker makes any, not where a stage on their way does not pass them on."""
    (warning,) = compose(["tracker=ground_truth", "viewer=viser", "dataset=tum", "dataset.path=."]).warnings
    assert warning.startswith("viewer gets no TrackerPhase: tracker: ")
    with pytest.raises(GraphError, match=r"set mapper.reads.Poses to one that does: tracker"):
        compose(["mapper.reads.Poses=evaluator"])


def test_a_parameter_of_a_slot_that_is_off_is_not_taken_in_silence() -> None:
    (warning,) = compose(["viewer.port=8000"]).warnings
    assert warning == "viewer.port: not used, as there is no viewer; --help lists what viewer= may be"


def test_external_keeps_the_choice() -> None:
    assert fake("relay=external").slots["relay"].placement.external
    assert fake("relay=external").slots["relay"].node is Relay


def test_inline_is_depth_first_and_deterministic(tmp_path: Path) -> None:
    orders = []
    for _ in range(2):
        sent: list[tuple[str, str]] = []
        nodes = run_inline(
            fake(f"output={tmp_path}", "source.count=3", "relay.stride=2"),
            lambda slot, node, message: sent.append((slot, type(message).__name__)),  # noqa: B023
        )
        orders.append(sent)
    frame = [("source", "Frame"), ("relay", "Keyframe"), ("source", "GroundTruth")]
    assert orders[0] == [*frame, ("source", "Frame"), ("source", "GroundTruth"), *frame, ("relay", "Poses")]
    assert orders[0] == orders[1]
    sink = nodes["sink"]
    assert isinstance(sink, Sink)
    assert (sink.keyframes, sink.truths, sink.poses) == ([0, 2], [0, 1, 2], 1)
    assert sink.seen_upstream["source"]["counts"] == {"frames": 3}
    assert sink.seen_upstream["relay"]["counts"] == {"keyframes": 2, "idle": 6}  # all idle work is done


def test_inline_lets_an_exception_through(tmp_path: Path) -> None:
    with pytest.raises(ArithmeticError, match="frame 1 cannot be relayed"):
        run_inline(fake(f"output={tmp_path}", "relay.fail_at=1"))


def test_addresses_of_ipv6_have_brackets(tmp_path: Path) -> None:
    for host in ("::1", "[::1]"):
        graph = fake("transport=tcp", f"host='{host}'", "port=17000")
        assert addresses(graph, tmp_path)["source.Frame"] == "tcp://[::1]:17000"


def test_who_is_started_elsewhere_finds_out_there_what_there_is() -> None:
    graph = fake("source=external", "source.device=auto", "relay=external", "relay.threads=3")
    specs = {
        name: spec(graph, name, defaultdict(str), own_threads(graph.slots[name]), None) for name in ("source", "relay")
    }
    assert (specs["source"]["config"]["device"], specs["source"]["threads"]) == ("auto", None)
    assert specs["relay"]["threads"] == 3
    assert fake("source=external", "source.device=auto", "device=cpu").slots["source"].config["device"] == "cpu"
    assert fake("source.device=auto").slots["source"].config["device"] in ("cpu", "cuda")


@pytest.mark.parametrize("cores", [1, 2, 3, 4, 8, 16, 64])
def test_threads_fit_the_cores(cores: int) -> None:
    plan = thread_plan(fake("relay.threads=5", "sink.cpu=[0]"), cores)
    assert plan["relay"] == 5
    assert plan["sink"] == 1
    assert 1 <= plan["source"] <= cores


def test_a_stage_on_a_gpu_leaves_the_cores_to_the_others() -> None:
    def plan(*overrides: str) -> dict[str, int]:
        return thread_plan(compose(["dataset=synthetic", "device=cpu", *overrides]), 16)

    without, beside = plan(), plan("mapper.device=cuda:1")
    assert (without["mapper"], beside["mapper"]) == (12, 1)
    assert (beside["mvs"], beside["evaluator"]) == (12, 16)
    assert beside["tracker"] > without["tracker"]
    assert plan("mapper.device=cuda", "mvs.device=cuda")["tracker"] == 12


@given(st.one_of(st.integers(-(2**53), 2**53), st.floats(allow_nan=False), st.text(), st.booleans(), st.none()))
def test_a_value_is_converted_to_its_type_or_refused(value: object) -> None:
    for annotation in (int, float, bool, int | None, float | str):
        fits = isinstance(value, annotation) and (annotation is bool or not isinstance(value, bool))
        if isinstance(value, int | float):
            fits &= abs(value) <= (LARGEST if isinstance(value, int) else sys.float_info.max)
        try:
            converted = convert(value, annotation, "x")
        except ParameterError:
            assert not fits
        else:
            assert isinstance(converted, annotation)
            assert converted == value


@pytest.mark.slow
def test_every_choice_file_of_the_project_composes() -> None:
    """One at a time, with the default choices elsewhere: its node exists, its parameters and reads hold."""
    stands_for_the_stages = [
        *(f"{slot}._target_=null" for slot in ("tracker", "mvs", "depth_fusion")),
        "mapper.reads={FusedKeyframe: dataset, TrackedFrame: dataset, Poses: dataset}",
        "evaluator.reads={GroundTruth: dataset, Trajectory: dataset, FusedKeyframe: dataset, SplatMap: mapper}",
    ]
    for slot in defaults_of(CONF):
        for path in sorted((CONF / slot).glob("*.yaml")):
            others = stands_for_the_stages if (slot, path.stem) == ("dataset", "resumed") else []
            compose([f"{slot}={path.stem}", "device=cpu", *others])
