"""Who may open a page of ours: only what the page itself asks for. A browser lets any page that its user has open ask
any address, those of this machine too; it only says from where (`Origin`) and by which name (`Host`)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from nodes.runtime.addresses import is_loopback

_making = threading.Lock()
_PORTS = {"http": 80, "https": 443}  # of an address that names none
_ADVICE = "give the name at which a proxy shows it: viewer.names=[NAME], or `mvsgs view --name NAME`"


def in_address(host: str) -> str:
    """A host as it stands in the address of a page: one of IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def check_names(names: Sequence[str], option: str) -> None:
    """Raises ValueError for what can be no name of a host."""
    for name in names:
        if not name or _place(f"//{name}") != (name.lower(), None):
            raise ValueError(f"{option}: {name!r} is no host's name, such as maps.example.org, without scheme and port")


@contextmanager
def guarded(host: str, names: Sequence[str] = ()) -> Iterator[None]:
    """The servers that are made in here, listening at `host` and shown by a proxy at `names`, answer no other page:
    viser has no option for that.

    Raises RuntimeError where none was made in the way that viser does it.
    """
    guards: list[_Guard] = []
    plain: Callable[..., Any] = websocket_server.serve

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        guards.append(_Guard(host, names, process_request))
        return plain(*arguments, process_request=guards[-1], **options)

    with _making:
        setattr(websocket_server, "serve", serve)  # noqa: B010
        try:
            yield
        finally:
            setattr(websocket_server, "serve", plain)  # noqa: B010
    if not guards:
        raise RuntimeError("this release of viser opens its page in a way that cannot be guarded: see constraints.txt")


class _Guard:
    def __init__(
        self, host: str, names: Sequence[str], answer: Callable[[ServerConnection, Request], Any] | None
    ) -> None:
        """answer: the server's own, of what is let in."""
        self._host, self._names, self._answer = host, names, answer
        self._told = False

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        why = refusal(request.headers, self._host, self._names)
        if why is None:
            answer: Response | None = self._answer(connection, request) if self._answer else None
            return answer
        if not self._told:
            self._told = True
            logging.warning("the page was refused: %s", why)
        return connection.respond(HTTPStatus.FORBIDDEN, f"refused: {why}\n")


def refusal(headers: Headers, host: str, names: Sequence[str] = ()) -> str | None:
    """Why a server that listens at `host`, and that a proxy shows at `names`, does not answer a request with these
    headers; None: it does. A proxy keeps the header Host or puts its own there."""
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    known = {name.lower() for name in names}
    name, _ = _place(f"//{asked}")
    if is_loopback(host) and not is_loopback(name) and name not in known:  # else a name of another's that leads here
        place = f"http://{in_address(host)}"
        return f"it is at {host}, and was asked for at {asked!r}: open it at {place} or localhost, or {_ADVICE}"
    if origin is None or _place(origin)[0] in known or _same_place(origin, asked):
        return None
    return f"a page of {origin!r} asked for it, at {asked!r}; if that is its own, {_ADVICE}"


def _same_place(origin: str, asked: str) -> bool:
    scheme = origin.partition("://")[0].lower()
    (name, port), (asked_name, asked_port) = _place(origin), _place(f"//{asked}")
    usual = _PORTS.get(scheme)
    return name != "" and (name, port or usual) == (asked_name, asked_port or usual)


def _place(address: str) -> tuple[str, int | None]:
    """Name and port of an address, the name in small letters; no name where it is none."""
    try:
        parts = urlsplit(address)
        return parts.hostname or "", parts.port
    except ValueError:
        return "", None
