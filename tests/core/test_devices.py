"""A GPU is taken only where Triton can compile what launches its kernels; what is missing there is said."""

from __future__ import annotations

import re
import sysconfig
from pathlib import Path

import pytest
import torch

from launch.global_device import GlobalDevice
from launch.refusal import GraphError
from mvsgs import doctor
from mvsgs_core import devices, machine
from mvsgs_core.devices import resolve_device, torch_device


@pytest.fixture(autouse=True)
def complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with a GPU and all that Triton needs, in this folder."""
    compiler, headers = tmp_path / "bin/gcc", tmp_path / "include"
    compiler.parent.mkdir()
    compiler.write_text("#!/bin/sh\n")
    compiler.chmod(0o755)
    headers.mkdir()
    (headers / "Python.h").touch()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(devices, "is_installed", lambda name: True)
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(headers)})
    monkeypatch.setenv("PATH", str(compiler.parent))
    monkeypatch.delenv("CC", raising=False)
    return tmp_path


def take_away(what: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Returns how it is had again."""
    if what == "triton":
        monkeypatch.setattr(devices, "is_installed", lambda name: name != "triton")
        return "Triton is missing: pip install triton"
    if what == "headers":
        (folder / "include/Python.h").unlink()
        return "Triton finds no Python.h: sudo apt install python3-dev"
    if what == "CC":
        monkeypatch.setenv("CC", "no-such-cc")
        return r"Triton finds no C compiler \(CC=no-such-cc\): sudo apt install gcc"
    (folder / "bin/gcc").unlink()
    return "Triton finds no C compiler: sudo apt install gcc"


def test_a_gpu_is_taken_where_triton_has_what_it_needs(complete: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_device("auto") == torch_device("auto") == "cuda"
    assert resolve_device("cuda:1") == torch_device("cuda:1") == "cuda:1"
    (complete / "bin/gcc").rename(complete / "bin/clang")
    assert resolve_device("auto") == "cuda"
    (complete / "bin/clang").rename(complete / "bin/mycc")
    monkeypatch.setenv("CC", "mycc")
    assert resolve_device("auto") == "cuda"


@pytest.mark.parametrize("what", ["triton", "compiler", "CC", "headers"])
def test_a_gpu_without_what_triton_needs(what: str, complete: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remedy = take_away(what, complete, monkeypatch)
    with pytest.warns(UserWarning, match=f"^the GPU is not used: {remedy}$"):
        assert resolve_device("auto") == "cpu"
    with pytest.raises(ValueError, match=f"^device=cuda:1: {remedy}; or use device=cpu$"):
        resolve_device("cuda:1")
    assert [resolve_device(device) for device in ("cpu", "torch")] == ["cpu", "torch"]
    assert [torch_device(device) for device in ("cpu", "torch", "cuda:1")] == ["cpu", "cpu", "cuda:1"]


def test_without_a_gpu_nothing_is_said(complete: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take_away("compiler", complete, monkeypatch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == torch_device("auto") == "cpu"


def test_doctor_says_why_a_gpu_is_not_used(
    complete: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine, "gpus", lambda: ["A GPU"])
    doctor.main(["--no-test"])
    assert "device=cpu leaves it alone" in capsys.readouterr().out
    take_away("compiler", complete, monkeypatch)
    doctor.main(["--no-test"])
    assert "; not used: Triton finds no C compiler: sudo apt install gcc\n" in capsys.readouterr().out


@pytest.mark.parametrize("what", ["triton", "compiler", "headers"])
def test_a_run_is_launched_on_the_cpu_then_and_says_why(
    what: str, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert GlobalDevice("auto").resolved == "cuda"
    assert GlobalDevice("cuda:0").resolved == "cuda:0"
    remedy = take_away(what, complete, monkeypatch)
    device = GlobalDevice("auto")
    assert device.resolved == "cpu"
    (warning,) = device.warnings
    assert re.search(remedy, warning)
    with pytest.raises(GraphError, match=remedy):
        _ = GlobalDevice("cuda:0").resolved
