"""A stream that Ctrl-C ends is never taken for a whole one, however slow its readers are or its camera is."""

from __future__ import annotations

import signal

import pytest

from tests.support.launches import Launch, launch
from tests.support.patience import until
from tests.support.processes import graph

pytestmark = pytest.mark.slow

__all__ = ["launch"]  # the fixture


def test_a_stream_whose_reader_is_slow_is_cut_off_where_it_was_and_no_read_is_blamed(launch: type[Launch]) -> None:
    """Each message waits for longer than a read may take."""
    run = launch("source.count=100", "source.size=[480,640]", "relay.seconds=2.5", "relay.tell_at=1", "buffer=1")
    until(lambda: "is at frame 1" in run.log("relay"))
    run.ctrl_c()
    code, out, err = run.finish()
    assert code == 0, err
    assert "did not return" not in out + run.log("source")
    assert run.report()["cut_off"]["source"].startswith("the stream was ended by Ctrl-C after ")


def test_a_stream_that_ends_in_a_read_that_hangs_is_cut_off_too() -> None:
    with graph() as g:
        g.diamond(source={"count": 10**6, "hang_at": 7})
        source = g.processes["source"]
        source.wait_for(lambda status: status.get("counts", {}).get("frames") == 7)
        source.popen.send_signal(signal.SIGINT)
        assert set(g.wait().values()) == {0}
        upstream = g.joined["upstream"]["source"]
        assert "did not return" in upstream["warnings"][0]
        assert upstream["values"]["cut_off"] == "the stream was ended by Ctrl-C after 7 frames"
