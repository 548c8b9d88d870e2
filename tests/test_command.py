"""The command `mvsgs`, as a user runs it: from a folder of data, with what people guess."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from mvsgs import command
from tests.support.dataset_folders import write_photos
from tests.support.shared_data import ROOT
from tests.support.tiny_map import write_tiny_run

ENTRY = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from mvsgs.command import main; sys.exit(main())"


def mvsgs(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """As the script that pip makes of the entry point: the current directory is on no path."""
    return subprocess.run(
        [sys.executable, "-I", "-c", ENTRY, *words], cwd=folder, capture_output=True, text=True, timeout=120
    )


def test_the_installed_script_calls_it() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    module, _, name = scripts["mvsgs"].partition(":")
    assert getattr(importlib.import_module(module), name) is command.main


@pytest.mark.parametrize("words", [[], ["--help"], ["help"]])
def test_alone_it_says_what_there_is(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(words) == 0
    said = capsys.readouterr().out
    assert all(f"  mvsgs {name} " in said for name in command.COMMANDS)


def test_every_command_that_is_a_module_takes_words_and_a_name() -> None:
    for name, entry in command.COMMANDS.items():
        if entry.module:
            with pytest.raises(SystemExit) as asked:
                importlib.import_module(entry.module).main(["--help"], prog=f"mvsgs {name}")
            assert asked.value.code == 0


@pytest.mark.slow
def test_what_is_named_is_composed_as_run_all_does(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    (tmp_path / "numpy.py").write_text("raise SystemExit('imported from the data')")
    shown = mvsgs(tmp_path, "graph", "photos/", "viewer=viser")
    assert shown.returncode == 0, shown.stderr
    assert "dataset=images" in shown.stdout
    assert "viewer=viser" in shown.stdout
    known = mvsgs(tmp_path, "parameters", "camera")
    assert "dataset=camera: nodes.camera.Camera" in known.stdout, known.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["exprot", "map.ply", "x.spz"], "error: exprot: no command, file or folder (did you mean export?)"),
        (["wlak.mp4"], "error: wlak.mp4: there is no such file or folder here"),
        (["photos", "mapper.iteration=3"], "mapper.iteration"),
        (["export", "nothing.ply", "x.spz"], "export: nothing.ply is missing: a map is a map.ply, or the output"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(words: list[str], said: str, tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 2)
    refused = mvsgs(tmp_path, *words)
    assert refused.returncode in (1, 2)
    assert refused.stdout == ""
    assert said in refused.stderr
    assert refused.stderr.count("\n") == 1


@pytest.mark.parametrize("first", ["", "graph", "view", "export", "info", "render"])
def test_a_name_that_is_no_utf_8_is_refused(first: str, tmp_path: Path) -> None:
    name = os.fsdecode(b"walk\xe9.mp4")
    (tmp_path / name).touch()
    refused = mvsgs(tmp_path, *filter(None, [first]), name, "out")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == "error: walk\\udce9.mp4: this name is no valid UTF-8; rename it, by hand or with convmv\n"


def test_so_is_a_folder_in_which_nothing_could_be_written(tmp_path: Path) -> None:
    here = tmp_path / os.fsdecode(b"photos\xe9")
    here.mkdir()
    for words in (["walk.mp4"], ["info", "."]):
        refused = mvsgs(here, *words)
        assert refused.returncode == 2
        assert "photos\\udce9: this name is no valid UTF-8" in refused.stderr


def test_a_map_is_named_by_its_folder_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_tiny_run(tmp_path / "run")
    assert command.main(["export", str(run), str(tmp_path / "small.spz")]) == 0
    assert (tmp_path / "small.spz").stat().st_size > 0
    assert "splats" in capsys.readouterr().out
