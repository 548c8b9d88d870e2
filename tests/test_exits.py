"""A node that calls sys.exit has failed as by any error: it is named, what it said is kept, and all may save."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from launch.compose import compose
from launch.inline import run_inline
from msgs import Frame, Keyframe
from nodes import Node
from nodes.runtime.runner import Runner
from tests.support.fake_graph.stages import Relay, Sink, Source
from tests.support.processes import graph

FAKE = Path(__file__).parent / "support" / "fake_graph" / "conf"


class Leaving(Node):
    """Frame -> nothing; exits where it is told to."""

    @dataclass
    class Config:
        where: str = "on_frame"  # hook
        text: str | None = None  # None: as if all were well
        path: str = "."  # where it leaves a note that it was asked to save

    config: Config

    def __init__(self, config: Any = None) -> None:
        super().__init__(config)
        self._leave("__init__")

    def on_frame(self, frame: Frame) -> Iterator[Keyframe]:
        self._leave("on_frame")
        yield from ()

    def on_idle(self) -> list[Keyframe] | None:
        self._leave("on_idle")
        return None

    def on_end(self) -> Iterator[Keyframe]:
        self._leave("on_end")
        yield from ()

    def on_abort(self, reason: str) -> None:
        Path(self.config.path, "aborted").write_text(reason)
        self._leave("on_abort")

    def _leave(self, where: str) -> None:
        if where == self.config.where:
            sys.exit(0 if self.config.text is None else self.config.text)


class LeavingSource(Source):
    def run(self) -> Iterator[Frame]:
        yield from ()
        sys.exit("no camera")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "text", "said"),
    [
        ("__init__", None, "0"), ("on_frame", "no weights", "'no weights'"), ("on_idle", None, "0"),
        ("on_end", None, "0"),
    ],
)  # fmt: skip
def test_the_node_that_exits_is_the_one_that_failed(tmp_path: Path, where: str, text: str | None, said: str) -> None:
    with graph() as g:
        config = {"where": where, "text": text, "path": str(tmp_path)}
        g.start("leaving", f"{__name__}.Leaving", {"Frame": "source"}, {}, config)
        if where != "__init__":
            g.start("source", "tests.support.sample_nodes.Source", {}, {"Frame": 1}, {"count": 3})
        assert g.wait()["leaving"] == 1
        last = g.processes["leaving"].last
        error = f"RuntimeError: leaving called sys.exit({said}): a node that cannot go on raises an error"
        assert (last["state"], last["error"], last["peer"]) == ("failed", error, False)
        assert f"in {where}" in last["traceback"]
        assert where == "__init__" or (tmp_path / "aborted").read_text() == error


@pytest.mark.slow
def test_a_source_that_exits_is_the_one_that_failed() -> None:
    with graph() as g:
        g.start("left", "tests.support.sample_nodes.Left", {"Frame": "source"}, {})
        g.start("source", f"{__name__}.LeavingSource", {}, {"Frame": 1})
        assert g.wait() == {"left": 1, "source": 1}
        assert "source called sys.exit('no camera')" in g.processes["source"].last["error"]


def test_in_one_process_an_exit_is_an_error_too(tmp_path: Path) -> None:
    words = [f"relay._target_={__name__}.Leaving", "~sink", f"relay.path={tmp_path}", f"output={tmp_path}"]
    with pytest.raises(RuntimeError, match=r"^relay called sys.exit\(0\)"):
        run_inline(compose(words, FAKE))
    assert "relay called sys.exit(0)" in (tmp_path / "aborted").read_text()
    with pytest.raises(RuntimeError, match=r"^relay called sys.exit\('no GPU'\)"):
        run_inline(compose([*words, "relay.where=__init__", "relay.text='no GPU'"], FAKE))


def test_who_exits_while_it_saves_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Runner("leaving", Leaving(Leaving.Config(where="on_abort", path=str(tmp_path)))).abort("stopped")
    assert "leaving: on_abort failed" in caplog.text
    assert "leaving called sys.exit(0)" in caplog.text


def test_a_node_that_cannot_save_hides_no_error_and_keeps_no_other_from_saving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(self: Node, reason: str) -> None:
        raise OSError(28, "No space left on device")

    saved: list[str] = []
    monkeypatch.setattr(Relay, "on_abort", full)
    monkeypatch.setattr(Sink, "on_abort", lambda self, reason: saved.append(reason))
    with caplog.at_level(logging.ERROR), pytest.raises(ArithmeticError, match="frame 2 cannot be relayed"):
        run_inline(compose([f"output={tmp_path}", "relay.fail_at=2"], FAKE))
    assert saved == ["ArithmeticError: frame 2 cannot be relayed"]
    assert "relay: on_abort failed" in caplog.text
    assert "No space left on device" in caplog.text
