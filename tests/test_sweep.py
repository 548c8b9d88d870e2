"""The folder of a sweep: one that is named is treated as a run's, one that is not belongs to no other sweep."""

from __future__ import annotations

from pathlib import Path

import pytest

import launch.sweep
from launch.refusal import GraphError
from launch.run_all import hydra_arguments
from launch.sweep import made_folder, named_folder

SWEEP = ["-m", "dataset.options.frames=8", "seed=1,2"]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The home is elsewhere, too."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    return tmp_path


def swept_into(*words: str) -> Path:
    """What Hydra is told."""
    (told,) = [word for word in hydra_arguments([*SWEEP, *words]) if word.startswith("hydra.sweep.dir=")]
    return Path(told.partition("=")[2])


def test_sweeps_of_the_same_second_have_a_folder_each(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch.sweep.time, "strftime", lambda form: "now")
    first, second = swept_into(), swept_into()
    assert (first, second) == (here / "runs" / "now-sweep", here / "runs" / "now-sweep-2")
    assert first.is_dir()
    assert second.is_dir()


@pytest.mark.parametrize("word", ["output=", "output=null"])
def test_an_output_that_names_nothing_is_as_none(word: str, here: Path) -> None:
    assert swept_into(word).parent == here / "runs"


@pytest.mark.parametrize(
    ("word", "folder"),
    [
        ("output=~/s", "home/s"),
        ("output=a/b", "a/b"),
        ("++output=c", "c"),
        ("output=2024", "2024"),
        ("output='é'", "é"),
    ],
)
def test_an_output_is_the_folder_that_a_run_would_have(word: str, folder: str, here: Path) -> None:
    assert named_folder([word]) == here / folder


def test_a_folder_that_is_named_is_made(here: Path) -> None:
    assert swept_into("output=a/b") == here / "a" / "b"
    assert (here / "a" / "b").is_dir()
    assert list((here / "a" / "b").iterdir()) == []


def test_a_folder_that_hydra_is_told_already_stays(here: Path) -> None:
    assert swept_into("hydra.sweep.dir=own") == Path("own")
    assert not (here / "runs").exists()


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("output=a,b", "output=a,b: the jobs of a sweep are numbered folders in one output; give one name"),
        ("output=[a]", "output=[a]: must be the name of a folder; write output=./NAME"),
        ("output=runs/${seed}", "output=runs/${seed}: a sweep's output takes no value of another key: "),
    ],
)
def test_an_output_that_is_no_name_of_a_folder_is_refused(word: str, said: str) -> None:
    with pytest.raises(GraphError) as refused:
        named_folder([word])
    assert str(refused.value).startswith(said)


@pytest.mark.parametrize(
    ("name", "said"),
    [("home", "is your home folder"), ("a/b", "a is a file"), ("a" * 300, "File name too long")],
)
def test_a_folder_that_is_none_for_results_is_refused(name: str, said: str, here: Path) -> None:
    (here / "a").touch()
    with pytest.raises(GraphError, match=rf"^output={here}/{name}: .*{said}"):
        made_folder(here / name)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="there is no /proc, in which nobody can make a folder")
@pytest.mark.parametrize("folder", ["/proc", "/proc/sweep"])
def test_a_folder_in_which_nothing_can_be_written_is_refused(folder: str) -> None:
    with pytest.raises(GraphError, match=f"^output={folder}: "):
        made_folder(Path(folder))
