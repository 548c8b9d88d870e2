"""The folder of what can be had again: XDG_CACHE_HOME's, the home's, or none, of which no command breaks."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvsgs_core import weights
from mvsgs_core.cache_folder import cache_folder


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
