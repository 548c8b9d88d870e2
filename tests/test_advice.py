"""What a node advises of another slot: taken where nobody chose it, said, and never against a choice."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from launch.advice import advised
from launch.compose import CONF, graph_of, prepare
from launch.jobs import Job
from nodes import Advice
from nodes.photographs_tracker import PhotographsTracker
from nodes.reader import Reader
from tests.support.shared_data import shared

WIDE = Advice("photographs", "steps are wide", {"because": "steps are wide"})


def job(*words: str) -> Job:
    prepared = prepare(words)
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        config = hydra_compose("config", prepared, return_hydra_config=True)
    return Job(config, prepared, dict(config.hydra.runtime.choices), None)


def advise_wide(cls: type, config: object) -> Mapping[str, Advice]:
    return {"tracker": WIDE}


def test_advice_is_taken_said_and_part_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reader, "advise", classmethod(advise_wide))
    asked = job("dataset=synthetic", "output=/nowhere")
    taken, notes = advised(asked)
    assert notes == ["tracker=photographs: steps are wide"]
    assert taken.command == f"{asked.command} tracker=photographs"
    tracker = graph_of(taken.config, taken.overrides, taken.choices).slots["tracker"]
    assert tracker.node is PhotographsTracker
    assert PhotographsTracker(tracker.parameters).core.stats.warnings.lines() == ["steps are wide"]
    assert OmegaConf.select(asked.config, "tracker._target_") == "nodes.tracker.Tracker"  # the job given is as it was


@pytest.mark.parametrize("word", ["tracker=dense", "tracker=ground_truth", "tracker.area=70000"])
def test_a_choice_wins(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reader, "advise", classmethod(advise_wide))
    asked = job("dataset=synthetic", word)
    assert advised(asked) == (asked, [])


def test_advice_for_what_is_there_is_only_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reader, "advise", classmethod(lambda cls, config: {"tracker": Advice("dense", "too many")}))
    asked = job("dataset=synthetic")
    assert advised(asked) == (asked, ["too many"])


def test_what_cannot_run_is_not_taken_and_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reader, "advise", classmethod(advise_wide))
    asked = job("dataset=synthetic", "keep_map=true")
    same, notes = advised(asked)
    assert same is asked
    assert len(notes) == 1
    assert notes[0].startswith("steps are wide; tracker=photographs is not taken, for keep_map: ")


@pytest.mark.parametrize(
    ("path", "stride", "wide"),
    [("strecha/fountain-P11", 1, True), ("fox", 1, True), ("tum_fr1_xyz", 1, False), ("tum_fr1_xyz", 8, True)],
)
def test_photographs_and_frames_of_a_video(path: str, stride: int, wide: bool) -> None:
    found = Reader.advise(Reader.Config(name="images", path=str(shared(f"data/{path}")), stride=stride))
    assert {slot: advice.choice for slot, advice in found.items()} == ({"tracker": "photographs"} if wide else {})
