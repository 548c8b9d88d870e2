"""What ROS 2 can ask of a run, as services; each becomes a Request, and the Reply to it the service's."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msgs import Asked, Reply, Request
from mvsgs_core.kept_map import tracker_file
from mvsgs_core.mapping.checkpoints.files import state_files
from mvsgs_core.stats import Stats
from nodes.ros2.cdr import CdrError
from nodes.ros2.connection import Connection
from nodes.ros2.services import SET_BOOL, TRIGGER, ServiceType

if TYPE_CHECKING:
    from nodes.ros2.dds import Call, Participant, Service

TYPES: dict[Asked, ServiceType] = {
    Asked.PAUSE: SET_BOOL, Asked.LOCALIZE: SET_BOOL,
    Asked.SAVE_MAP: TRIGGER, Asked.LOAD_MAP: TRIGGER, Asked.RESET: TRIGGER,
}  # fmt: skip


@dataclass(kw_only=True)
class Names:
    """Names of services; with an empty one it is not offered."""

    pause: str = "mvsgs/pause"  # SetBool: true, frames are not taken; false, they are again
    save_map: str = "mvsgs/save_map"  # Trigger: the map as it is goes to a folder of its own, which the reply names
    load_map: str = "mvsgs/load_map"  # Trigger: goes on in a map that was saved, see `load`; the run's own is saved
    localize: str = "mvsgs/localize"  # SetBool: true, frames are only found in the map; false, the map grows again
    reset: str = "mvsgs/reset"  # Trigger: a new map; the one before is saved


class Services:
    """Opened services and the requests on their way."""

    def __init__(self, participant: Participant, connection: Connection, names: Names, stats: Stats) -> None:
        self._stats = stats
        self._open: dict[Asked, Service] = {
            asked: participant.service(connection.topic(name), TYPES[asked])
            for asked in Asked
            if (name := getattr(names, asked.value))
        }
        self._waiting: dict[int, tuple[Service, Call]] = {}  # by the request's number
        self._asked = 0

    def new(self, maps: Path, load: str | None) -> list[Request]:
        """What was asked since. maps: the folder of saved maps; load: the map for load_map; None: the newest there."""
        found = []
        for asked, service in self._open.items():
            for call in service.take():
                if isinstance(call, CdrError):
                    self._stats.refuse("requests", 1, f"what is no request of {asked} was left out: {call}")
                    continue
                self._asked += 1
                self._waiting[self._asked] = service, call
                self._stats.count("requests")
                try:
                    found.append(self._request(asked, bool(getattr(call.request, "data", True)), maps, load))
                except ValueError as error:
                    self.reply(Reply(self._asked, False, str(error)))
        return found

    def reply(self, reply: Reply) -> None:
        service, call = self._waiting.pop(reply.number)
        service.reply(call, reply.success, reply.message)

    def close(self, why: str) -> None:
        """What was asked and not done is answered; nothing more is taken."""
        for number in list(self._waiting):
            self.reply(Reply(number, False, why))
        self._open.clear()

    def _request(self, asked: Asked, on: bool, maps: Path, load: str | None) -> Request:
        """Raises ValueError, saying what to do."""
        new = maps / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{self._asked}"
        folder = kept = ""
        if asked == Asked.SAVE_MAP:
            folder = str(new)
        elif asked == Asked.LOAD_MAP:
            folder = newest(maps) if load is None else str(Path(load).expanduser().absolute())
        if asked in (Asked.LOAD_MAP, Asked.RESET):
            kept = str(new)
        return Request(self._asked, asked.value, on, folder, kept)


def newest(maps: Path) -> str:
    """The map in that folder that was saved last, with both its halves. Raises ValueError where there is none."""
    folders = [folder for folder in maps.iterdir() if state_files(folder)] if maps.is_dir() else []
    there = [file for folder in folders if (file := tracker_file(folder)).is_file()]
    if not there:
        raise ValueError(f"{maps} has no map: save one, or set publisher.load=DIR to the output of a keep_map=true run")
    return str(max(there, key=lambda file: file.stat().st_mtime_ns).parent.parent)


__all__ = ["Names", "Services", "newest"]
