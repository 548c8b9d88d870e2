"""The newcomer's wheel is one of the commit that is recorded."""

from __future__ import annotations

import argparse
import os
import subprocess
import time
from pathlib import Path

import pytest

from bench import newcomer

PROJECT = '[tool.scikit-build.wheel.packages]\nmvsgs = "mvsgs"\n"mvsgs/workspace/nodes" = "nodes"\n'
DAY = 24 * 3600


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Committed ten days ago, its files as old."""
    at = time.time() - 10 * DAY
    files = {
        "pyproject.toml": PROJECT,
        "mvsgs/command.py": "",
        "nodes/mapper.py": "",
        "README.md": "",
        ".gitignore": "dist\n",
    }
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
        os.utime(file, (at, at))
    monkeypatch.setattr(newcomer, "ROOT", tmp_path)
    git(tmp_path, "init", "--quiet")
    commit(tmp_path, at)
    return tmp_path


def git(folder: Path, *words: str, at: float = 0.0) -> None:
    who = {f"GIT_{role}_{what}": "a@b" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    dates = {f"GIT_{role}_DATE": f"{at:.0f} +0000" for role in ("AUTHOR", "COMMITTER")}
    subprocess.run(["git", "-C", str(folder), *words], env={**os.environ, **who, **dates}, check=True)


def commit(folder: Path, at: float) -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "x", at=at)


def wheel(folder: Path, days: float) -> Path:
    """One that was built so many days ago."""
    file = folder / "dist" / "mvsgs-0.1.0-cp311.whl"
    file.parent.mkdir(exist_ok=True)
    file.touch()
    os.utime(file, (time.time() - days * DAY,) * 2)
    return file


class Begun(Exception):
    """The measurement."""


def refused(monkeypatch: pytest.MonkeyPatch) -> bool:
    def begin(path: Path) -> None:
        raise Begun

    monkeypatch.setattr(newcomer, "record_video", begin)
    with pytest.raises((Begun, SystemExit)) as ended:
        newcomer.measure(argparse.Namespace(wheel=None, quick=True))
    assert ended.type is Begun or "`make wheel`" in str(ended.value)
    return ended.type is SystemExit


def test_a_wheel_that_is_older_than_what_it_is_made_of_is_refused(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert refused(monkeypatch)  # there is none
    wheel(checkout, 11)
    assert refused(monkeypatch)
    wheel(checkout, 9)
    assert not refused(monkeypatch)
    (checkout / "README.md").write_text("no part of what runs")
    assert not refused(monkeypatch)
    (checkout / "nodes" / "mapper.py").write_text("changed")
    assert refused(monkeypatch)
    commit(checkout, time.time() - 8 * DAY)
    assert refused(monkeypatch)
    wheel(checkout, 7)
    assert not refused(monkeypatch)
    (checkout / "mvsgs" / "new.py").touch()
    assert refused(monkeypatch)
