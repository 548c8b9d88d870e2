"""Keys are taken only where nobody else could have made, changed or read them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from mvsgs import keys
from nodes.runtime.addresses import KEY_FILE, TransportError, load_keys
from nodes.runtime.transport import create_keys


def linked(folder: Path) -> None:
    (folder / KEY_FILE).rename(folder / "elsewhere")
    (folder / KEY_FILE).symlink_to(folder / "elsewhere")


def piped(folder: Path) -> None:
    (folder / KEY_FILE).unlink()
    os.mkfifo(folder / KEY_FILE, 0o600)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: (f / KEY_FILE).unlink(), "no keys at .*mvsgs keys"),
        (lambda f: (f / KEY_FILE).chmod(0o640), "read by other users: chmod 600"),
        (lambda f: f.chmod(0o777), "written by other users.*chmod go-w"),
        (lambda f: f.chmod(0o720), "written by other users.*chmod go-w"),
        (linked, "is a link: put the file itself there"),
        (piped, "is no file"),
        (lambda f: (f / KEY_FILE).write_bytes(b"x" * 10_000_000), "no key pair"),
    ],
    ids=["missing", "readable", "all write", "group writes", "link", "pipe", "giant"],
)
def test_keys_that_others_have_a_hand_in_are_refused(
    tmp_path: Path, change: Callable[[Path], object], match: str
) -> None:
    folder = tmp_path / "keys"
    made = create_keys(folder)
    assert load_keys(folder) == made
    change(folder)
    with pytest.raises(TransportError, match=match):
        load_keys(folder)


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("what", ["file", "folder"])
def test_keys_of_another_user_are_refused(tmp_path: Path, what: str) -> None:
    folder = tmp_path / "keys"
    create_keys(folder)
    os.chown(folder if what == "folder" else folder / KEY_FILE, 12345, 12345)
    with pytest.raises(TransportError, match=r"another user \(number 12345\).*copy them into a folder of your own"):
        load_keys(folder)


def test_another_users_keys_are_refused_whoever_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As any user but the owner; root's own files are anybody's to use."""
    folder = tmp_path / "keys"
    create_keys(folder)
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    if owner == 0:
        load_keys(folder)
    else:
        with pytest.raises(TransportError, match="another user"):
            load_keys(folder)


def test_the_command_makes_keys_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert keys.main([str(folder)]) == 0
    made = load_keys(folder)
    assert keys.main([str(folder)]) == 1
    assert (
        capsys.readouterr().err == f"error: {folder}/graph.key is there already: copy it, or delete it for new keys\n"
    )
    assert load_keys(folder) == made


@pytest.mark.parametrize(("below", "said"), [("", "is a file"), ("below", "{} is a file")])
def test_where_a_file_is_there_are_no_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], below: str, said: str
) -> None:
    file = tmp_path / "file"
    file.touch()
    assert keys.main([str(file / below)]) == 1
    assert capsys.readouterr().err == f"error: {file / below}: {said.format(file)}; give the name of a folder\n"


def test_why_keys_cannot_be_written_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert keys.main(["/proc/none"]) == 1
    assert capsys.readouterr().err == "error: /proc/none: No such file or directory\n"
