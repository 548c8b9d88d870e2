from __future__ import annotations

import argparse
import datetime
import pickle
import re
import sys
import types
from pathlib import Path

import pytest
import torch
from torch import nn

from mvsgs_core.networks import checkpoints


class _Settings(dict[str, int]):
    """A placeholder has no items."""


class _Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (print, ("executed",))


def test_prefix_and_place(tmp_path: Path) -> None:
    net = nn.Linear(2, 3)
    state = {f"module.{k}": v for k, v in net.state_dict().items()}
    torch.save({"state_dict": state, "epoch": 3, "arguments": argparse.Namespace(lr=1.0)}, tmp_path / "a.pth")
    other = nn.Linear(2, 3)
    checkpoints.load(other, checkpoints.read(tmp_path / "a.pth", inside="state_dict"), tmp_path / "a.pth")
    assert torch.equal(other.weight, net.weight)
    assert not other.weight.requires_grad


def test_bad_files_are_named(tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    with pytest.raises(FileNotFoundError, match=r"w\.pth"):
        checkpoints.read(file)
    torch.save({"epoch": 3, "nets": {"weight": torch.zeros(2)}}, file)
    with pytest.raises(ValueError, match=r"holds no tensors, .*under state_dict, model, .*its keys: 'epoch', 'nets'"):
        checkpoints.read(file, inside="model")
    torch.save([torch.zeros(2)], file)
    with pytest.raises(ValueError, match="holds a list, no state dict"):
        checkpoints.read(file)
    torch.save({"weight": torch.zeros(2)}, file)
    with pytest.raises(ValueError, match="does not fit Linear"):
        checkpoints.load(nn.Linear(2, 3), checkpoints.read(file), file)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="truncated or no PyTorch checkpoint"):
        checkpoints.read(file)
    file.write_bytes(b"")
    with pytest.raises(ValueError, match="truncated or no PyTorch checkpoint"):
        checkpoints.read(file)


def test_a_pickled_configuration_is_left_out_and_nothing_of_it_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As MVSFormer's files: an object of a class that only its authors have, with a path, a date and a function."""
    module = types.ModuleType("parse_config")
    monkeypatch.setitem(sys.modules, "parse_config", module)
    parser = type("ConfigParser", (), {"__module__": "parse_config"})
    module.ConfigParser = parser  # type: ignore[attr-defined]
    config = parser()
    config.__dict__ |= {"dir": Path("x"), "day": datetime.datetime(2023, 1, 1), "levels": {"a": [1, 2]}, "run": _Evil()}
    file = tmp_path / "model_best.pth"
    torch.save({"state_dict": {"module.a": torch.arange(3.0)}, "config": config, "monitor_best": 0.1}, file)
    monkeypatch.delitem(sys.modules, "parse_config")
    state = checkpoints.read(file, inside="state_dict")
    assert state.keys() == {"a"}
    torch.testing.assert_close(state["a"], torch.arange(3.0))
    assert "executed" not in capsys.readouterr().out
    assert "parse_config" not in sys.modules


def test_what_cannot_be_left_out_is_refused_with_a_way_out(tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    torch.save({"state_dict": {"a": torch.zeros(1)}, "config": _Settings(a=1)}, file)
    with pytest.raises(ValueError, match=r"not executed \(.*_Settings\).*weights_only=False\), NEW_FILE"):
        checkpoints.read(file)
    with pytest.raises(ValueError, match=r"not executed.*save its state dict alone") as refusal:
        checkpoints.read(file, inside="state_dict")
    advice = re.search(r"torch\.save\(.*NEW_FILE\)", str(refusal.value))
    assert advice is not None
    new = tmp_path / "new.pth"
    eval(advice[0], {"torch": torch, "FILE": file, "NEW_FILE": new})  # what follows it is taken
    assert checkpoints.read(new, inside="state_dict").keys() == {"a"}


def test_an_older_files_python_objects_are_told_from_a_file_that_was_cut_off(tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    content = {"state_dict": {"a": torch.zeros(1)}, "config": _Settings(a=1)}
    torch.save(content, file, _use_new_zipfile_serialization=False)
    with pytest.raises(ValueError, match=r"not executed.*save its state dict alone"):
        checkpoints.read(file)


@pytest.mark.parametrize("key", [None, "state_dict", "model", "model_state_dict"])
@pytest.mark.parametrize("inside", [None, "state_dict"])
def test_a_state_dict_is_found_where_others_keep_it(key: str | None, inside: str | None, tmp_path: Path) -> None:
    state = {"module.a": torch.ones(1), "module.spiral": torch.ones(1, dtype=torch.complex64)}
    torch.save(state if key is None else {key: state, "optimizer": {}}, tmp_path / "w.pth")
    assert checkpoints.read(tmp_path / "w.pth", inside=inside).keys() == {"a"}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"<!DOCTYPE html><html>Virus scan warning</html>", "is a web page"),
        (b"\xef\xbb\xbf\r\n<html>", "is a web page"),
        (b'{"error": "access denied"}', "truncated or no PyTorch checkpoint"),
        (pickle.dumps(Path("x")), "truncated or no PyTorch checkpoint"),
        (b"\0" * 1000, "truncated or no PyTorch checkpoint"),
    ],
)
def test_what_a_failed_download_leaves_is_not_taken_for_a_pickle(content: bytes, said: str, tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=said) as refusal:
        checkpoints.read(file)
    assert "weights_only=False" not in str(refusal.value)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    state = {"weight": torch.ones(3, 2), "bias": torch.tensor([0.0, torch.nan, 1.0])}
    with pytest.raises(ValueError, match=r"w\.pth has values that are not finite in 1 of 2 tensors, as in bias"):
        checkpoints.load(nn.Linear(2, 3), state, tmp_path / "w.pth")


def test_a_file_is_checked_without_a_network(tmp_path: Path) -> None:
    file = str(tmp_path / "w.pth")

    def build() -> nn.Module:
        assert torch.get_default_device().type == "meta", "its tensors take no memory"
        return nn.BatchNorm2d(3)

    torch.save({"model": nn.BatchNorm2d(3).state_dict()}, file)
    checkpoints.check(build, "itermvs", file, inside="model")
    torch.save({"model": nn.BatchNorm2d(3).state_dict()}, file, _use_new_zipfile_serialization=False)
    checkpoints.check(build, "itermvs", file, inside="model")
    torch.save({"model": nn.BatchNorm2d(4).state_dict()}, file)
    with pytest.raises(ValueError, match=r"does not fit BatchNorm2d: .*size mismatch.*fetch itermvs"):
        checkpoints.check(build, "itermvs", file, inside="model")
    checkpoints.check(build, "itermvs", checkpoints.RANDOM)


def test_droid_rows() -> None:
    assert checkpoints.droid_rows({"update.delta.2.bias": torch.tensor(0.0)})["update.delta.2.bias"].ndim == 0
    state = {"update.weight.2.weight": torch.zeros(3, 128, 3, 3), "update.delta.2.bias": torch.zeros(3)}
    state["fnet.conv1.bias"] = torch.zeros(32)
    assert {k: len(v) for k, v in checkpoints.droid_rows(state).items()} == {
        "update.weight.2.weight": 2,
        "update.delta.2.bias": 2,
        "fnet.conv1.bias": 32,
    }
