"""Services of ROS 2: rmw_cyclonedds's bytes, replies to who asked, and a run that does what it is asked to."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvsgs_core.kept_map import NOTHING_MAPPED
from nodes.localization_file import FILE
from nodes.ros2 import services
from nodes.ros2.cdr import decode, encode
from nodes.ros2.connection import Connection
from tests.support.patience import LONG, until
from tests.support.ros2_messages import example, plain
from tests.support.ros2_peer import OWN_DOMAIN, SERVICES, Peer, service_type
from tests.support.shared_data import ROOT

pytest.importorskip("cyclonedds", reason="ROS 2 is reached by cyclonedds (pip install cyclonedds)")
pytest.importorskip("rosbags", reason="the other program has rosbags' definitions")
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("kind", SERVICES)
def test_bytes_are_rosbags_with_the_header_of_rmw_cyclonedds(kind: str) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for end, text in zip(("Request", "Response"), SERVICES[kind]):
        ours = example(getattr(services, kind + end), np.random.default_rng(3))
        store.register(service_type(f"{kind}_{end}", text))
        name = f"std_srvs/msg/{kind}_{end}"
        assert ours.ros == name.replace("msg", "srv")
        theirs = bytes(store.serialize_cdr(store.types[name](**plain(ours)), name, little_endian=True))
        assert encode(ours) == theirs
        assert theirs[4:20] == ours.guid.to_bytes(8, "little") + ours.seq.to_bytes(8, "little", signed=True)
        assert decode(type(ours), theirs) == ours


def test_each_client_gets_its_own_replies_and_what_is_no_request_none(peer: Peer) -> None:
    from nodes.ros2.cdr import CdrError
    from nodes.ros2.dds import Participant

    service = Participant(Connection(domain=OWN_DOMAIN)).service("/switch", services.SET_BOOL)
    other = Peer()
    for one in (peer, other):
        one.client("/switch", "SetBool")
    peer.ask("/switch", times=2, data=True)
    other.ask("/switch", data=False)
    calls: list[Any] = []
    until(lambda: calls.extend(service.take()) or len(calls) >= 3)
    assert not any(isinstance(call, CdrError) for call in calls)
    for call in reversed(calls):
        service.reply(call, call.request.data, "on" if call.request.data else "off")
    assert [(r["seq"], r["success"], r["message"]) for r in peer.replies("/switch", 2)] == [
        (2, True, "on"),
        (1, True, "on"),
    ]
    assert [(r["seq"], r["success"], r["message"]) for r in other.replies("/switch")] == [(1, False, "off")]
    other.kill()


class Run:
    """A run of the room, as another process sees it."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.peer = Peer()
        self.peer.subscribe("/mvsgs/pose", "geometry_msgs/msg/PoseStamped", depth=1000)
        self._process = subprocess.Popen(
            [sys.executable, ROOT / "launch/run_all.py", f"output={output}", "publisher=ros2", "device=cpu",
             "dataset.options.frames=3000", "dataset.size=[96,128]", "mapper.iterations=1", "mapper.refinement=0",
             "evaluator.max_frames=0", "evaluator.lpips=off", "tracker.threads=1"],
            cwd=output.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, "ROS_DOMAIN_ID": str(OWN_DOMAIN), "PYTHONPATH": ""},
        )  # fmt: skip
        self._known: set[str] = set()

    def ask(self, service: str, data: bool | None = None) -> tuple[bool, str]:
        name = f"/mvsgs/{service}"
        if service not in self._known:
            self._known.add(service)
            self.peer.client(name, "Trigger" if data is None else "SetBool")
        self.peer.ask(name, **({} if data is None else {"data": data}))
        (reply,) = self.peer.replies(name)
        return reply["success"], reply["message"]

    def stamps(self, count: int = 1) -> list[float]:
        """Of at least so many poses that come from now on, seconds."""
        self.peer.taken("/mvsgs/pose")
        stamps = [pose["header"]["stamp"] for pose in self.peer.wait_for("/mvsgs/pose", count)]
        return [stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps]

    def quiet(self) -> bool:
        """Whether no pose comes for a while: what was on its way is here."""
        self.peer.taken("/mvsgs/pose")
        time.sleep(0.5)
        return not self.peer.taken("/mvsgs/pose")

    def end(self) -> dict[str, Any]:
        """The report, after Ctrl-C."""
        self._process.send_signal(signal.SIGINT)
        said = self._process.communicate(timeout=LONG)[0]
        assert self._process.returncode == 0, said
        self.peer.close()
        return json.loads((self.output / "report.json").read_text())  # type: ignore[no-any-return]

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()
        self.peer.kill()


def test_a_run_does_what_it_is_asked_to(tmp_path: Path) -> None:
    from mvsgs_core.maps.info import info

    run = Run(tmp_path / "run")
    try:
        assert run.ask("save_map") == (False, NOTHING_MAPPED)
        run.stamps(8)
        assert run.ask("pause", True) == (True, "paused")
        until(run.quiet)
        saved, message = run.ask("save_map")
        assert saved, message
        folder = Path(message.partition(":")[0])
        assert folder.parent == tmp_path / "run/maps"
        assert "splats" in info(folder)[0]
        time.sleep(0.5)
        assert run.peer.taken("/mvsgs/pose") == []
        assert run.ask("pause", False) == (True, "the stream goes on")
        assert run.ask("localize", True)[0]
        found = tmp_path / "run" / FILE
        until(lambda: found.is_file() and len(found.read_text().splitlines()) > 5)
        assert run.ask("localize", False) == (True, "the map grows again")
        done, message = run.ask("load_map")
        assert done, message
        assert message.startswith(f"the camera is looked for in {folder}; the one before is in ")
        run.stamps()
        done, message = run.ask("reset")
        assert done, message
        kept = Path(message.partition("is in ")[2].partition(":")[0])
        assert info(kept)
        run.stamps(8)
        report = run.end()
    finally:
        run.kill()
    assert report["trajectory"]["first_tracked"] > 8
    assert "another map was begun on request" in " ".join(report["warnings"]["tracker"])
