"""The short-named directory of a run's sockets and specs. What a killed launcher left is removed by the next one."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from launch.graph import Graph
from launch.refusal import GraphError
from launch.specs import topic_of
from nodes.runtime.addresses import IPC_PATH_BYTES
from nodes.runtime.spec import gone_file

PREFIX = "mvsgs-"
LOCK = "launcher.lock"  # held by the run's launcher as long as it lives


class RunDirectory:
    """Gone when the run is."""

    def __init__(self, graph: Graph) -> None:
        """Raises GraphError where no directory has a name short enough for a socket's address."""
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base_directory(graph)))
        aside = self.path / f"{LOCK}.new"
        self._lock = os.open(aside, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        aside.rename(self.path / LOCK)  # under its name only once it is held: nobody takes it for an orphan

    def tell_gone(self, node: str) -> None:
        """Those who still wait for that observer go on without it."""
        gone_file(self.path, node).touch()

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def remove_orphans() -> list[Path]:
    """Removes this user's run directories whose launcher is gone, and says which."""
    removed = []
    for base in _bases():
        for directory in base.glob(f"{PREFIX}*"):
            with suppress(OSError), _orphaned(directory) as orphaned:
                if orphaned:
                    shutil.rmtree(directory)
                    removed.append(directory)
    return removed


@contextmanager
def _orphaned(directory: Path) -> Iterator[bool]:
    """Whether it is a run directory of this user that no launcher holds; held here meanwhile. Raises OSError."""
    status = directory.lstat()
    if status.st_uid != os.getuid() or not directory.is_dir() or directory.is_symlink():
        yield False
        return
    lock = os.open(directory / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    finally:
        os.close(lock)


def _bases() -> list[Path]:
    return [Path(base) for base in dict.fromkeys((tempfile.gettempdir(), "/tmp")) if Path(base).is_dir()]


def base_directory(graph: Graph) -> Path:
    """Where run directories are made. Raises GraphError where its name is too long for a socket's address."""
    topics = [topic_of(edge) for edge in graph.edges] if graph.settings.transport == "ipc" else []
    longest = max(map(len, topics), default=0)
    for base in _bases():
        if len(os.fsencode(base)) + len(f"/{PREFIX}12345678/") + longest <= IPC_PATH_BYTES:
            return base
    raise GraphError(
        f"the path of a socket in {tempfile.gettempdir()} would be longer than {IPC_PATH_BYTES} bytes: "
        "set TMPDIR to a shorter one, or transport=tcp"
    )
