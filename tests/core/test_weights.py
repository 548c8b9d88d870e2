from __future__ import annotations

import http.server
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from mvsgs_core import weights
from mvsgs_core.networks import checkpoints
from tests.support.shared_data import shared

CONTENT = bytes(range(256)) * 9000


class _Server(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT with ranges; the first answer breaks off in the middle."""

    broken = True
    knows_ranges = True
    missing = False
    ranges: list[str | None] = []  # noqa: RUF012 - written by all requests of a test

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        type(self).ranges.append(asked)
        if type(self).missing:
            self.send_error(404)
            return
        asked = asked if type(self).knows_ranges else None
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
    monkeypatch.setattr(_Server, "knows_ranges", True)
    monkeypatch.setattr(_Server, "missing", False)
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
    size = len(CONTENT)
    entry = replace(weights.REGISTRY["raft_small"], url=url, sha256=weights.checksum(reference), size=size)
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


def test_a_server_that_cannot_resume_starts_again(url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _register(monkeypatch, url, tmp_path)
    monkeypatch.setattr(_Server, "knows_ranges", False)
    with pytest.raises(ConnectionError, match=r"only \d+ of \d+ bytes arrived"):
        weights.fetch("raft_small")
    assert weights.fetch("raft_small").read_bytes() == CONTENT


def test_what_came_in_full_but_was_not_verified_needs_no_request(
    url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    _register(monkeypatch, url, tmp_path)
    part = weights.folders()[-1] / "raft-small.pth.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(CONTENT)
    assert weights.fetch("raft_small").read_bytes() == CONTENT
    assert _Server.ranges == []


def _main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["weights", *arguments])
    return weights.main()


def test_progress_is_shown(
    url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _register(monkeypatch, url, tmp_path)
    monkeypatch.setenv("COLUMNS", "140")
    assert _main(monkeypatch, "fetch", "raft_small") == 1  # breaks off in the middle
    broken = capsys.readouterr()
    assert "try again" in broken.err
    assert _main(monkeypatch, "fetch", "raft_small") == 0
    out, err = capsys.readouterr()
    assert out.strip().endswith("raft-small.pth")
    assert "raft-small.pth" in err
    assert "100%" in err
    assert "2.3/2.3 MB" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fetch", "raft_small"), r"Connection refused.*try again, or: https://github.com/princeton-vl/RAFT"),
        (("fetch", "droid"), r"cannot be downloaded by a program: get it from https://github.com/princeton-vl/DROID"),
        (("fetch", "resnet"), r"no weights 'resnet'; there are: .*raft_small"),
        (("check", "nowhere.pth"), r"there is no file nowhere.pth: python -m mvsgs_core.weights list"),
    ],
)
def test_every_failure_is_one_line_and_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with socket.socket() as unused:  # a port that nobody listens at: as good as no network
        unused.bind(("127.0.0.1", 0))
        _register(monkeypatch, f"http://127.0.0.1:{unused.getsockname()[1]}/w.pth", tmp_path)
        assert _main(monkeypatch, *arguments) == 1
    err = capsys.readouterr().err.strip()
    assert err.startswith("error: ")
    assert "\n" not in err
    assert re.search(said, err)


def test_a_file_that_is_gone_from_the_server(
    url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _register(monkeypatch, url, tmp_path)
    monkeypatch.setattr(_Server, "missing", True)
    assert _main(monkeypatch, "fetch", "raft_small") == 1
    assert re.search(r"404.*https://github.com/princeton-vl/RAFT", capsys.readouterr().err)


def test_the_list_says_where_each_is_found_and_where_it_can_be_had(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    (tmp_path / "droid.pth").write_bytes(b"x")
    assert _main(monkeypatch, "list") == 0
    out = capsys.readouterr().out
    for entry in weights.REGISTRY.values():
        assert entry.name in out
        assert entry.license in out
        assert (entry.url or entry.page) in out
    assert f"here: {tmp_path / 'droid.pth'}\n" in out
    assert f"looked for in {tmp_path}, " in out


def test_loading_says_what_to_fetch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MVSGS_WEIGHTS", str(tmp_path))
    net = nn.Linear(2, 3)
    file = tmp_path / "raft-small.pth"
    torch.save({"module.weight": net.weight, "module.bias": net.bias}, file)
    other = nn.Linear(2, 3)
    assert checkpoints.load_registered(other, "raft_small") == file
    assert torch.equal(other.weight, net.weight)
    with pytest.raises(ValueError, match=r"does not fit Conv2d.*for the right one: get it from https.*RAFT"):
        checkpoints.load_registered(nn.Conv2d(1, 1, 1), "raft_small")
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ValueError, match=r"truncated or no PyTorch.*for the right one: get it from https.*RAFT"):
        checkpoints.load_registered(other, "raft_small")
    with pytest.raises(ValueError, match=r"python -m mvsgs_core.weights fetch itermvs"):
        checkpoints.load_registered(other, "itermvs", file, inside="model")


def test_a_wrong_file_is_not_kept(url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _register(monkeypatch, url, tmp_path, good=False)
    monkeypatch.setattr(_Server, "broken", False)
    with pytest.raises(ValueError, match="another file than expected"):
        weights.fetch("raft_small")
    assert not list((tmp_path / "mvsgs").rglob("*.p*"))


def test_what_cannot_be_read_is_said_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "folder.pth").mkdir()
    for path, said in ((tmp_path / "none.pth", "there is no file"), (tmp_path / "folder.pth", "there is no file")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", ["weights", "check", str(path)])
            assert weights.main() == 1
        assert said in capsys.readouterr().err
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["weights", "check", str(tmp_path)])
        patch.setattr(weights, "check", lambda path: path.read_bytes())
        assert weights.main() == 1
    assert f"Is a directory: '{tmp_path}'" in capsys.readouterr().err, "not the number of the error alone"


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
    assert "named as droid" in weights.check(tmp_path / "given" / "droid.pth")
    (tmp_path / "given" / "droid.pth").write_bytes(b"\n<html>Google Drive - Virus scan warning</html>")
    with pytest.raises(ValueError, match="a web page, no weights"):
        weights.check(tmp_path / "given" / "droid.pth")


def test_published_files_are_recognized_and_a_truncated_one_is_not(tmp_path: Path) -> None:
    file = shared("weights/raft-small.pth")
    assert "raft_small (RAFT, small model), intact" in weights.check(file)
    assert file.stat().st_size == weights.REGISTRY["raft_small"].size
    cut = tmp_path / "raft-small.pth"
    cut.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"truncated \(3984714 of 3984814 bytes\).*get it from https"):
        weights.check(cut)
    cut.write_bytes(b"x" * 4_000_000)
    with pytest.raises(ValueError, match=r": another file; get it from https"):
        weights.check(cut)
    with pytest.raises(ValueError, match="none of the registered weights"):
        weights.check(cut.rename(tmp_path / "unknown.pth"))
