"""`mvsgs doctor`: it sees what is there and what is not, and its self-test fails where a run does."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from mvsgs import WORKSPACE, doctor
from mvsgs_core import native, weights


def test_it_names_kernels_packages_and_weights(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main(["--no-test"]) == 0
    said = capsys.readouterr().out
    assert "rasterizer, mapping, tracking, mvs, fusion, scene: " in said
    assert said.count("\nweights ") == len(weights.REGISTRY)
    assert said.endswith("all is well\n")


def test_kernels_that_are_not_built_are_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(name: str) -> None:
        raise ImportError(f"`_{name}` are not built")

    monkeypatch.setattr(native, "load", missing)
    assert doctor.main(["--no-test"]) == 1
    said = capsys.readouterr().out
    assert "! kernels                      `_rasterizer` are not built" in said
    assert said.endswith("to be looked at: kernels\n")


@pytest.mark.parametrize(
    ("forced", "code", "found"), [("generic", 0, "scene: generic\n"), ("v9", 1, "MVSGS_ARCH=v9: ")]
)
def test_kernels_that_are_forced_are_said(forced: str, code: int, found: str) -> None:
    script = "import sys; from mvsgs.doctor import main; sys.exit(main(['--no-test']))"
    env = {**os.environ, "MVSGS_ARCH": forced}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=env, cwd=WORKSPACE)
    assert done.returncode == code, done.stderr
    (processor,) = [line for line in done.stdout.splitlines() if "processor  " in line]
    assert "generic kernels" in processor if code == 0 else found in processor
    assert found in done.stdout


def test_an_open3d_that_does_not_load_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused() -> None:
        raise ImportError("open3d does not load (libEGL.so.1): sudo apt install libegl1")

    monkeypatch.setattr(doctor, "open3d", refused)
    assert doctor.main(["--no-test"]) == 1
    said = capsys.readouterr().out
    assert "for meshes: open3d does not load (libEGL.so.1): sudo apt install libegl1" in said
    assert said.endswith("to be looked at: open3d\n")


def test_a_disk_that_takes_no_file_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)  # what was found before
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "gone")])
    assert doctor.main([]) == 1
    said = capsys.readouterr().out
    assert "! disk                         no folder takes temporary files: free some room, or set TMPDIR to a" in said
    assert said.count("\nweights ") == len(weights.REGISTRY)
    assert (
        f"self-test                      ! cannot be made: No usable temporary directory found in ['{tmp_path}" in said
    )
    assert said.endswith("to be looked at: disk, self-test\n")


@pytest.mark.slow
def test_the_self_test_maps_the_room(tmp_path: Path) -> None:
    reached, right = doctor.self_test(tmp_path)
    assert right, reached
    assert reached.startswith("30 of 30 frames tracked, held-out PSNR 3")


def test_a_run_that_fails_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(command, 1, "", "error: no\nmore")

    monkeypatch.setattr(doctor.subprocess, "run", failing)
    assert doctor.self_test(tmp_path) == ("failed with code 1: error: no", False)
