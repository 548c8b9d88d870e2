"""Who may open a page of ours: only what the page itself asks for. A browser lets any page that its user has open ask
any address, those of this machine too; it only says from where (`Origin`) and by which name (`Host`)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
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


@contextmanager
def guarded(host: str) -> Iterator[None]:
    """The servers that are made in here, listening at `host`, answer no other page: viser has no option for that.

    Raises RuntimeError where none was made in the way that viser does it.
    """
    guards: list[_Guard] = []
    plain: Callable[..., Any] = websocket_server.serve

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        guards.append(_Guard(host, process_request))
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
    def __init__(self, host: str, answer: Callable[[ServerConnection, Request], Any] | None) -> None:
        """answer: the server's own, of what is let in."""
        self._host, self._answer = host, answer
        self._told = False

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        why = refusal(request.headers, self._host)
        if why is None:
            answer: Response | None = self._answer(connection, request) if self._answer else None
            return answer
        if not self._told:
            self._told = True
            logging.warning("the page was refused: %s", why)
        return connection.respond(HTTPStatus.FORBIDDEN, f"refused: {why}\n")


def refusal(headers: Headers, host: str) -> str | None:
    """Why a server that listens at `host` does not answer a request with these headers; None: it does."""
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    if is_loopback(host) and not is_loopback(_name(asked)):  # else a name of another's that leads here
        return f"it is at {host}, and was asked for at {asked!r}: open it at http://{host}, or at localhost"
    if origin is not None and origin.lower().partition("://")[2] != asked.lower():
        return f"a page of {origin!r} asked for it, at {asked!r}; a proxy before it must keep the header Host"
    return None


def _name(asked: str) -> str:
    try:
        return urlsplit(f"//{asked}").hostname or ""
    except ValueError:
        return ""
