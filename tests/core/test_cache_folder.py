"""The folder of what can be had again: XDG_CACHE_HOME's, the home's, or none, of which nothing breaks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mvsgs_core import weights
from mvsgs_core.cache_folder import cache_folder
from tests.support.shared_data import ROOT


@pytest.fixture
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user whom the system does not know, in a container that sets no HOME."""
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("MVSGS_WEIGHTS", raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    with pytest.raises(RuntimeError):
        Path.home()


def test_it_lies_in_the_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for none in (None, "", "relative/folder"):  # the specification ignores a relative path
        if none is None:
            monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        else:
            monkeypatch.setenv("XDG_CACHE_HOME", none)
        assert cache_folder() == tmp_path / ".cache" / "mvsgs"


def test_xdg_cache_home_needs_no_home(homeless: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "mvsgs"


def test_without_a_home_weights_that_are_given_are_found(
    homeless: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cache_folder() is None
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    assert weights.folders() == [tmp_path]
    file = tmp_path / weights.REGISTRY["raft_small"].files[0]
    file.touch()
    assert weights.find("raft_small") == file


def test_without_a_home_it_is_said_what_to_set(homeless: None) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no home.*set MVSGS_WEIGHTS"):
        weights.find("raft_small")
    with pytest.raises(ValueError, match="set XDG_CACHE_HOME to a folder"):
        weights.fetch("raft_small")


IMPORT = "import mvsgs_core.rasterizer.triton; from triton import knobs; print(knobs.cache.dir)"


def kernels_folder(**environment: str) -> Path:
    """Where a process keeps what Triton compiled, as Triton itself says."""
    given = {key: value for key, value in os.environ.items() if not key.startswith("TRITON_")}
    command = [sys.executable, "-c", IMPORT]
    done = subprocess.run(command, env=given | environment, cwd=ROOT, capture_output=True, text=True, check=True)
    return Path(done.stdout.strip())


@pytest.mark.slow
def test_compiled_kernels_are_kept_there(tmp_path: Path) -> None:
    pytest.importorskip("triton")
    assert kernels_folder(XDG_CACHE_HOME=str(tmp_path)) == tmp_path / "mvsgs/triton"
    assert (tmp_path / "mvsgs/triton").is_dir()
    for variable, folder in (("TRITON_CACHE_DIR", "own"), ("TRITON_HOME", "own/.triton/cache")):
        given = {variable: str(tmp_path / "own"), "XDG_CACHE_HOME": str(tmp_path / "other")}
        assert kernels_folder(**given) == tmp_path / folder
    assert not (tmp_path / "other").exists()


@pytest.mark.slow
def test_where_no_folder_can_be_written_they_are_kept_as_long_as_the_process(tmp_path: Path) -> None:
    pytest.importorskip("triton")
    (tmp_path / "home").touch()  # no folder: not even root can write into it
    (tmp_path / "temporary").mkdir()
    found = kernels_folder(XDG_CACHE_HOME=str(tmp_path / "home"), TMPDIR=str(tmp_path / "temporary"))
    assert found.parent == tmp_path / "temporary"
    assert list((tmp_path / "temporary").iterdir()) == []
