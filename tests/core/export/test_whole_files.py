"""An export is whole or as it was before, and never takes the place of what it is made from."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from mvsgs_core.export import __main__ as export
from mvsgs_core.video_file import write_video
from tests.support.tiny_map import write_tiny_run


@contextmanager
def full_disk(after: int = 200) -> Iterator[None]:
    """No file grows beyond so many bytes: writing raises OSError then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (after, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.spz", "a.txt", "a.glb", "a.obj", "a.off", "a.stl", "mesh.ply"])
def test_a_full_disk_leaves_the_file_of_before(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = write_tiny_run(tmp_path / "run"), tmp_path / name
    out.write_text("good")
    options = [] if name in ("a.ply", "a.splat", "a.spz", "a.txt") else ["--voxel", "0.05"]
    options += ["--mesh"] if name == "mesh.ply" else []
    with full_disk():
        assert export.main([str(run), str(out), *options]) == 1
    assert "File too large" in capsys.readouterr().err
    assert out.read_text() == "good"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, "run"])


def test_a_flight_that_is_broken_off_leaves_the_video_of_before(tmp_path: Path) -> None:
    def frames() -> Iterator[np.ndarray]:
        yield from np.zeros((100, 8, 8, 3), dtype=np.uint8)  # more than the encoder looks ahead
        raise KeyboardInterrupt

    (tmp_path / "flight.mp4").write_text("good")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "flight.mp4", frames(), (8, 8), 30.0)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["good"]


@pytest.mark.parametrize(
    ("out", "options"),
    [
        ("map.ply", ["--fold"]),
        ("../run/map.ply", ["--mesh"]),
        ("cameras.json", ["--every", "2"]),
        ("poses.txt", ["--trajectory", "poses.txt"]),
        ("georeference.json", []),
    ],
)
def test_what_is_read_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], out: str, options: list[str]
) -> None:
    run = write_tiny_run(tmp_path / "run")
    (run / "poses.txt").write_bytes((run / "trajectory.txt").read_bytes())
    (run / "georeference.json").write_text("{}")
    monkeypatch.chdir(run)
    before = Path(out).read_bytes()
    assert export.main([str(run), out, *options]) == 1
    assert f"{out} is read for this export, which would replace it: give another file" in capsys.readouterr().err
    assert Path(out).read_bytes() == before


def test_a_link_stays_one_and_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, there = write_tiny_run(tmp_path / "run"), tmp_path / "there.ply"
    link = tmp_path / "link.ply"
    link.symlink_to(there)
    assert export.main([str(run), str(link)]) == 0
    assert link.is_symlink()
    assert there.stat().st_size > 1000
    assert export.main([str(run), str(tmp_path / "nowhere/map.ply")]) == 1
    assert f"there is no folder {tmp_path / 'nowhere'}" in capsys.readouterr().err
