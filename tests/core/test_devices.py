"""A GPU is taken only where PyTorch runs on it and Triton can launch its kernels; what is missing there is said."""

from __future__ import annotations

import re
import sysconfig
from pathlib import Path

import pytest
import torch

from launch.checks import check
from launch.compose import compose
from launch.global_device import GlobalDevice
from launch.refusal import GraphError
from mvsgs import doctor
from mvsgs_core import devices, machine
from mvsgs_core.devices import resolve_device, torch_device
from tests.support.shared_data import ROOT

CUDA_12 = r"make clean setup PIP_FLAGS='--extra-index-url https://download\.pytorch\.org/whl/cu126'"


@pytest.fixture(autouse=True)
def complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with two of the oldest GPUs that PyTorch is built for, and all that Triton needs, in this folder."""
    compiler, headers = tmp_path / "bin/gcc", tmp_path / "include"
    compiler.parent.mkdir()
    compiler.write_text("#!/bin/sh\n")
    compiler.chmod(0o755)
    headers.mkdir()
    (headers / "Python.h").touch()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: ["sm_75", "sm_80", "sm_90a", "compute_120"])
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda number: (7, 5))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(devices, "is_installed", lambda name: True)
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(headers)})
    monkeypatch.setenv("PATH", str(compiler.parent))
    monkeypatch.delenv("CC", raising=False)
    return tmp_path


def take_away(what: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Returns how it is had again."""
    if what == "driver":
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        return rf"CUDA 13\.0 does not start, most often as the driver is too old for it: renew that, or: {CUDA_12}"
    if what == "capability":
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda number: (7, 0))
        return rf"this PyTorch is built for GPUs of capability 7\.5 and newer, and it has 7\.0: {CUDA_12}"
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


@pytest.mark.parametrize("what", ["driver", "capability", "triton", "compiler", "CC", "headers"])
def test_a_gpu_without_what_it_needs(what: str, complete: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remedy = take_away(what, complete, monkeypatch)
    with pytest.warns(UserWarning, match=f"^the GPU is not used: {remedy}$"):
        assert resolve_device("auto") == "cpu"
    with pytest.raises(ValueError, match=f"^device=cuda:1: {remedy}; or use device=cpu$"):
        resolve_device("cuda:1")
    assert [resolve_device(device) for device in ("cpu", "torch")] == ["cpu", "torch"]
    assert [torch_device(device) for device in ("cpu", "torch", "cuda:1")] == ["cpu", "cpu", "cuda:1"]


def test_each_gpu_is_judged_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda number: ((9, 0), (6, 1))[number])
    assert resolve_device("auto") == "cuda"
    with pytest.raises(ValueError, match=r"it has 6\.1: make"):
        resolve_device("cuda:1")
    assert GlobalDevice("cuda:0").resolved == "cuda:0"
    with pytest.raises(GraphError, match=r"it has 6\.1: make"):
        _ = GlobalDevice("cuda:1").resolved


def test_without_a_gpu_nothing_is_said(complete: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take_away("compiler", complete, monkeypatch)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert resolve_device("auto") == torch_device("auto") == "cpu"
    device = GlobalDevice("auto")
    assert (device.resolved, device.warnings) == ("cpu", [])


def test_doctor_says_why_a_gpu_is_not_used(
    complete: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def said() -> str:
        doctor.main(["--no-test"])
        return capsys.readouterr().out

    monkeypatch.setattr(machine, "gpus", lambda: ["A GPU"])
    assert "device=cpu leaves it alone" in said()
    take_away("compiler", complete, monkeypatch)
    assert "; not used: Triton finds no C compiler: sudo apt install gcc\n" in said()
    remedy = take_away("capability", complete, monkeypatch)
    assert re.search(rf"gpu +A GPU, CUDA 13\.0; not used: {remedy}\n", said())
    monkeypatch.setattr(machine, "gpus", lambda: [])
    remedy = take_away("driver", complete, monkeypatch)
    assert re.search(rf"gpu +not used: {remedy}\n", said())


@pytest.mark.parametrize("what", ["driver", "capability", "triton", "compiler", "headers"])
def test_a_run_is_launched_on_the_cpu_then_and_says_why(
    what: str, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert GlobalDevice("auto").resolved == "cuda"
    assert GlobalDevice("cuda:0").resolved == "cuda:0"
    remedy = take_away(what, complete, monkeypatch)
    device = GlobalDevice("auto")
    assert device.resolved == "cpu"
    (warning,) = device.warnings
    assert re.search(remedy, warning)
    with pytest.raises(GraphError, match=remedy):
        _ = GlobalDevice("cuda:0").resolved


@pytest.mark.parametrize("what", ["driver", "capability"])
def test_a_slot_s_own_gpu_is_one_that_pytorch_runs_on(
    what: str, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = compose([f"output={complete / 'out'}", "source.device=cuda:1"], ROOT / "tests/support/fake_graph/conf")
    take_away("compiler", complete, monkeypatch)  # PyTorch's own kernels need none
    check(graph)
    remedy = take_away(what, complete, monkeypatch)
    with pytest.raises(GraphError, match=rf"^source\.device=cuda:1: {remedy}; or use source\.device=cpu$"):
        check(graph)
