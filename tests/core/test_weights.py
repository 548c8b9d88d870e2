from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from mvsgs_core import weights
from tests.shared_data import shared

CONTENT = bytes(range(256)) * 9000


class _Server(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT with ranges; the first answer breaks off in the middle."""

    broken = True
    ranges: list[str | None] = []  # noqa: RUF012 - written by all requests of a test

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        type(self).ranges.append(asked)
        start = int(asked.removeprefix("bytes=").removesuffix("-")) if asked else 0
        body = CONTENT[start:]
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if type(self).broken:
            type(self).broken = False
            body = body[: len(body) // 2]
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def url(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("MVSGS_WEIGHTS", raising=False)
    monkeypatch.setattr(_Server, "broken", True)
    monkeypatch.setattr(_Server, "ranges", [])
    server = http.server.HTTPServer(("127.0.0.1", 0), _Server)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/w.pth"
    server.shutdown()
    thread.join()
    server.server_close()


def _register(monkeypatch: pytest.MonkeyPatch, url: str, tmp_path: Path, good: bool = True) -> None:
    reference = tmp_path / "reference"
    reference.write_bytes(CONTENT if good else b"other")
    entry = replace(weights.REGISTRY["raft_small"], url=url, sha256=weights.checksum(reference))
    monkeypatch.setitem(weights.REGISTRY, "raft_small", entry)


def test_a_broken_download_is_resumed(url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _register(monkeypatch, url, tmp_path)
    with pytest.raises(ConnectionError, match="try again"):
        weights.fetch("raft_small")
    with pytest.raises(FileNotFoundError, match="fetch raft_small"):
        weights.find("raft_small")  # half a file is not found
    path = weights.fetch("raft_small")
    assert path.read_bytes() == CONTENT
    assert _Server.ranges[0] is None
    assert _Server.ranges[1] is not None  # the second request asked for the rest only
    assert weights.find("raft_small") == path
    assert weights.fetch("raft_small") == path
    assert len(_Server.ranges) == 2  # what is there is not fetched again


def test_a_wrong_file_is_not_kept(url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _register(monkeypatch, url, tmp_path, good=False)
    monkeypatch.setattr(_Server, "broken", False)
    with pytest.raises(ValueError, match="another file than expected"):
        weights.fetch("raft_small")
    assert not list((tmp_path / "mvsgs").rglob("*.p*"))


def test_files_that_come_by_hand_say_where_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("MVSGS_WEIGHTS", raising=False)
    with pytest.raises(ValueError, match="Google Drive"):
        weights.fetch("droid")
    with pytest.raises(FileNotFoundError, match=r"Google Drive link.*set MVSGS_WEIGHTS"):
        weights.find("droid")
    with pytest.raises(KeyError, match=r"no weights 'resnet'; there are: .*raft_small"):
        weights.find("resnet")
    (tmp_path / "given").mkdir()
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path / "given"))
    (tmp_path / "given" / "droid.pth").write_bytes(b"x")
    assert weights.find("droid") == tmp_path / "given" / "droid.pth"


def test_published_files_are_recognized_and_a_truncated_one_is_not(tmp_path: Path) -> None:
    file = shared("weights/raft-small.pth")
    assert "raft_small (RAFT, small model), intact" in weights.check(file)
    assert file.stat().st_size == weights.REGISTRY["raft_small"].size
    cut = tmp_path / "raft-small.pth"
    cut.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match="truncated or another file"):
        weights.check(cut)
