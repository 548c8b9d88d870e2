"""The benchmark of mutated files: each kind of seed is read when sound, and what a file does to its worker is told."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from bench.faults import file_worker, files
from bench.faults.file_mutations import mutated
from bench.faults.file_seeds import SEEDS
from mvsgs_core.bad_file import BadFileError


@pytest.mark.parametrize("kind", SEEDS)
def test_a_sound_seed_is_read(tmp_path: Path, kind: str) -> None:
    way, target, make = SEEDS[kind]
    make(tmp_path)
    assert file_worker.read_through(way, tmp_path / target) > 0


@pytest.mark.parametrize("data", [b"", b"x", b"1 2.5 3 file.png\n" * 30, bytes(range(256)) * 20])
def test_a_mutation_is_repeatable_and_changes_something(data: bytes) -> None:
    drawn = [mutated(data, np.random.default_rng(k)) for k in range(200)]
    assert drawn == [mutated(data, np.random.default_rng(k)) for k in range(200)]
    if len(data) > 1:
        assert sum(d != data for d in drawn) > 150


def test_only_what_is_promised_counts_as_documented() -> None:
    def raised(action: object) -> Exception:
        try:
            action()  # type: ignore[operator]
        except Exception as error:
            return error
        raise AssertionError

    def bad() -> None:
        raise BadFileError("x")

    assert file_worker.documented(raised(bad))
    assert not file_worker.documented(raised(lambda: {}["x"]))
    assert not file_worker.documented(raised(lambda: np.zeros(3).reshape(2, 2))), "a ValueError, but not in our words"


@pytest.mark.slow
def test_a_worker_that_crashes_or_hangs_is_told_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    SEEDS["ply"][2](tmp_path)
    with files._Worker(tmp_path / "log") as worker:
        assert worker.read("ply", tmp_path / "map.ply")["frames"] == 1
        worker._process.kill()  # type: ignore[union-attr]
        worker._process.wait()  # type: ignore[union-attr]
        assert worker.read("ply", tmp_path / "map.ply") == {"ended": "killed by signal 9"}
        assert worker.read("ply", tmp_path / "map.ply")["frames"] == 1
        monkeypatch.setattr(files, "TIMEOUT", 0.0)
        worker._process.send_signal(signal.SIGSTOP)  # type: ignore[union-attr]
        assert worker.read("ply", tmp_path / "map.ply") == {"ended": "not done after 0 s"}
