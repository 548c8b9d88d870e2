"""A page on this machine that another page, open in the same browser, asks for what it shows."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser
import websockets.asyncio.server as websocket_server
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from mvsgs.view import main
from nodes.map_page import MapPage
from nodes.page_guard import guarded, refusal
from nodes.viewer import Viewer
from tests.support.ports import free_port
from tests.support.viewer_page import page

SERVE = websocket_server.serve


@pytest.fixture(scope="module")
def opened() -> Iterator[MapPage]:
    map_page = MapPage("127.0.0.1", free_port())
    yield map_page
    map_page.server.stop()


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null"])
def test_another_page_gets_nothing(opened: MapPage, origin: str) -> None:
    address, protocol = opened.url.replace("http", "ws"), Subprotocol(f"viser-v{viser.__version__}")
    with pytest.raises(InvalidStatus, match="403"), connect(address, origin=Origin(origin), subprotocols=[protocol]):
        pass
    with connect(address, origin=Origin(opened.url), subprotocols=[protocol], max_size=None) as itself:
        assert itself.recv(timeout=10)
    assert "ReplayDone" in page(opened.url)  # a program that is no browser


def test_a_name_that_leads_here_gets_nothing(opened: MapPage) -> None:
    port = opened.server.get_port()
    for name, status in (("evil.example", 403), ("", 403), ("[", 403), ("localhost", 200), ("127.0.0.1", 200)):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.request("GET", "/", headers={"Host": f"{name}:{port}"})
        answer = connection.getresponse()
        assert answer.status == status, name
        if status == 403:
            assert b"open it at http://127.0.0.1" in answer.read()
        connection.close()


def test_an_address_of_ipv6_is_one_that_a_browser_opens() -> None:
    map_page = MapPage("::1", free_port())
    try:
        assert map_page.url == f"http://[::1]:{map_page.server.get_port()}"
        assert "ReplayDone" in page(map_page.url)
    finally:
        map_page.server.stop()
    assert "open it at http://[::1] or localhost, or" in str(refusal(Headers(Host="evil.example"), "::1"))


def test_who_opens_it_to_the_network_may_be_asked_by_any_name_but_by_no_other_page() -> None:
    for name in ("robot.local:8080", "192.168.1.5:8080", "[fe80::1]:8080"):
        assert refusal(Headers(Host=name), "0.0.0.0") is None
        assert refusal(Headers(Host=name, Origin=f"http://{name}"), "0.0.0.0") is None
        assert refusal(Headers(Host=name, Origin="https://evil.example"), "0.0.0.0") is not None
    tunnel = Headers(Host="localhost:9000", Origin="http://localhost:9000")
    for host in ("127.0.0.1", "::1", "localhost"):
        assert refusal(tunnel, host) is None


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("kept", ["maps.example.org", "Maps.Example.org:443", "127.0.0.1:8080"])
def test_a_proxy_shows_it_at_a_name_that_was_given(host: str, kept: str) -> None:
    """It keeps the header Host, or puts its own there."""
    names = ["Maps.example.org"]
    for origin in ("https://maps.example.org", "https://maps.example.org:8443"):
        assert refusal(Headers(Host=kept, Origin=origin), host, names) is None
        said = refusal(Headers(Host=kept, Origin=origin), host, [])
        assert said is None or "viewer.names=[NAME]" in said
    assert refusal(Headers(Host=kept, Origin="https://evil.example"), host, names) is not None
    assert refusal(Headers(Host="127.0.0.1:8080", Origin="https://maps.example.org"), host) is not None


@pytest.mark.parametrize(
    ("origin", "asked", "same"),
    [
        ("http://robot.local", "robot.local:80", True),
        ("https://Robot.local", "robot.LOCAL:443", True),
        ("https://robot.local:443", "robot.local", True),
        ("http://[fe80::1]", "[fe80::1]:80", True),
        ("http://robot.local:8080", "robot.local:08080", True),
        ("http://robot.local:8080", "robot.local", False),
        ("https://robot.local", "robot.local:80", False),
        ("http://robot.local:x", "robot.local:8080", False),
        ("null", "", False),
    ],
)
def test_a_port_may_be_left_out_where_it_is_the_usual_one(origin: str, asked: str, same: bool) -> None:
    assert (refusal(Headers(Host=asked, Origin=origin), "0.0.0.0") is None) is same


def test_a_given_name_opens_the_page_and_no_other_does() -> None:
    map_page = MapPage("127.0.0.1", free_port(), ["maps.example.org"])
    try:
        for name, status in (("maps.example.org", 200), ("evil.example", 403)):
            connection = http.client.HTTPConnection("127.0.0.1", map_page.server.get_port(), timeout=10)
            connection.request("GET", "/", headers={"Host": name})
            assert connection.getresponse().status == status
            connection.close()
    finally:
        map_page.server.stop()


@pytest.mark.parametrize("name", ["https://maps.example.org", "maps.example.org:443", "maps.example.org/map", "", "["])
def test_what_is_no_name_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"names: .* is no host's name"):
        Viewer.check(Viewer.Config(port=0, names=[name]))
    assert main([str(tmp_path), "--port", "0", "--name", name]) != 0
    assert "--name: " in capsys.readouterr().err


def test_a_server_that_is_made_otherwise_is_not_taken_for_guarded() -> None:
    with pytest.raises(RuntimeError, match="cannot be guarded"), guarded("127.0.0.1"):
        pass
    assert websocket_server.serve is SERVE
