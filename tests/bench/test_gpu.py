"""The GPU benchmark's measuring, at a tiny size in Triton's interpreter; without a GPU it measures none."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.support.shared_data import ROOT

pytest.importorskip("triton", reason="triton is not installed: pip install triton to run its interpreter")

from bench import gpu, networks, record

pytestmark = [pytest.mark.slow, pytest.mark.gpu]

MEASURE = gpu.milliseconds


def test_every_row_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = {name: networks.CASES[name] for name in ("DROID update, an edge", "RAFT-small, a pair")}
    monkeypatch.setattr(networks, "CASES", kept)
    monkeypatch.setattr(gpu, "milliseconds", lambda *a, **k: MEASURE(*a, **{**k, "warmup": 0}))
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    rows = gpu.measure_on(device, (((18, 24), 30),), 64, (128, 160), rounds=1)
    names = [row.name for row in rows]
    assert len(set(names)) == len(names)
    for part in ("gaussian: forward", "exact: backward", "fraction of the roofline", "training iteration", "RAFT"):
        assert any(part in name for name in names), part
    assert all(isinstance(row.value, float) and row.value > 0 for row in rows)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_without_a_gpu_it_says_so_and_the_record_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "gpu.json"
    command = [sys.executable, "-m", "bench.gpu", "--json", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no CUDA GPU on this machine" in done.stdout
    assert json.loads(file.read_text()) == []
    monkeypatch.setattr(record, "DOCUMENT", tmp_path / "none.md")
    monkeypatch.setattr(record, "record", lambda *_: pytest.fail("an empty record would replace one from a GPU"))
    assert record.run(["gpu", str(file)]) == 0
