"""What the launcher prints of a command line without running it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_origin

import pytest

from launch.compose import CONF, compose
from launch.field_comments import field_comments
from launch.graph import load_node
from launch.graph_text import graph_text
from launch.help_text import MAX_WIDTH
from nodes.parameters import parameters
from tests.support.shared_data import ROOT


def run_all(*words: str) -> str:
    command = [sys.executable, ROOT / "launch/run_all.py", *words]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    assert shown.returncode == 0, shown.stderr
    return shown.stdout


@dataclass
class Commented:
    first: int = 1  # beside it
    # above it,
    # in two lines
    second: Sequence[float] = (1.0, 2.0)
    third: dict[str, int] = field(  # in the midst of it
        default_factory=lambda: {"what": 1, "is": 2, "too": 3, "long": 4, "for": 5, "one": 6, "line": 7}
    )
    fourth: int = 4

    fifth: str = "# no comment"


@dataclass
class Inherited(Commented):
    fourth: int = 5  # what the base does not say
    first: int = 6


def test_a_field_s_comment_is_read_where_it_stands() -> None:
    assert field_comments(Commented) == {
        "first": "beside it", "second": "above it, in two lines", "third": "in the midst of it",
    }  # fmt: skip
    assert field_comments(Inherited) == field_comments(Commented) | {"fourth": "what the base does not say"}


@pytest.mark.slow
def test_help_has_every_parameter_with_its_type_default_and_comment() -> None:
    shown = run_all("--help", "mapper=paper", "device=cpu")
    for word in ("dataset: ", "tum", "mapper", "--inline", "--graph", "tracker=external", "_target_=my_tracker"):
        assert word in shown
    lines = shown.splitlines()
    for slot, parameter, words in (
        ("mapper", "iterations=1000", ("int or null; ", "null: 15, in real time 30", "(default: null)")),
        ("tracker", "area=76800", ("int; pixels of the tracker's own image",)),
        ("dataset", "size=[240, 320]", ("[height, width]",)),
        ("slot", "cpu=null", ("[int] or null; cores to pin to",)),
    ):
        at = lines.index(next(line for line in lines if line.startswith(f"  {slot}.{parameter}")))
        for word in words:
            assert word in " ".join(line.strip() for line in lines[at : at + 3])
    assert any(line.startswith("  seed=0") for line in lines)
    assert sum("run_all.py" in line for line in lines) == 1  # who has a wheel has the command alone
    assert "The paper's parameters, where it gives them" in shown
    assert max(len(line) for line in lines if "/runs/" not in line) <= MAX_WIDTH


@pytest.mark.slow
@pytest.mark.parametrize("slot", ["tracker", "mvs", "depth_fusion", "mapper", "viewer", "evaluator", "recorder"])
def test_every_parameter_of_every_choice_says_what_it_is(slot: str) -> None:
    for file in (CONF / slot).glob("*.yaml"):
        target = next(line for line in file.read_text().splitlines() if line.startswith("_target_:")).split(": ")[1]
        if not target.startswith("null"):
            for parameter in parameters(load_node(slot, target).Config, slot):
                told = parameter.name in ("seed", "title") or get_origin(parameter.annotation) is Literal
                assert told or field_comments(parameter.owner).get(parameter.name), parameter.path


@pytest.mark.slow
def test_the_graph_is_shown_on_one_screen_and_nothing_runs(tmp_path: Path) -> None:
    shown = run_all("--graph", f"output={tmp_path}/new", "viewer=viser", "mvs=external", "dataset=camera")
    lines = shown.splitlines()
    assert len(lines) <= 30
    assert max(map(len, lines)) <= 130
    assert lines[0].split() == ["dataset=camera", "nodes.camera.Camera", "source"]
    assert lines[1].split() == ["Frame", "->", "tracker", "newest", "only"]
    assert ["mvs=plane_sweep", "nodes.mvs.Mvs", "external"] in [line.split() for line in lines]
    assert ["Depth", "->", "depth_fusion", "reliable"] in [line.split() for line in lines]
    assert ["viewer=viser", "nodes.viewer.Viewer", "observer"] in [line.split() for line in lines]
    assert "off: publisher, recorder" in lines
    assert not (tmp_path / "new").exists()


def test_every_edge_of_the_graph_is_in_its_text() -> None:
    graph = compose(["device=cpu"])
    arrows = [line.split()[:3] for line in graph_text(graph, {}).splitlines() if "->" in line]
    assert sorted(arrows) == sorted([edge.message.__name__, "->", edge.reader] for edge in graph.edges)


@pytest.mark.slow
def test_hydra_s_own_flags_work() -> None:
    assert "_target_: nodes.mapper.Mapper\n" in run_all("--cfg", "job", "mapper.window=5")
    assert "== Flags ==" in run_all("--hydra-help")
