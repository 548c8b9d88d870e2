"""A graph on two hosts, which are network namespaces with a cable between them; stages on one are killed and return."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from launch.children import python_environment
from nodes.runtime.transport import create_keys
from tests.support.launches import ROOT, Launch
from tests.support.patience import LONG, until

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

PORT = 17000  # below those of who connects: one of the stages' own connections would get a killed one's, now and then


@dataclass(frozen=True)
class Host:
    name: str
    address: str

    @property
    def inside(self) -> list[str]:
        """What a command is preceded by."""
        return ["nsenter", f"--net=/var/run/netns/{self.name}"]


def ip(*words: str, host: Host | None = None) -> None:
    """Skips the test where that is not permitted."""
    command = [*([] if host is None else host.inside), "ip", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONG)
    if done.returncode and re.search("permitted|denied", done.stderr):
        pytest.skip(f"two hosts need network namespaces, which are not permitted here: {done.stderr.strip()}")
    assert done.returncode == 0, f"{command}: {done.stderr}"


@pytest.fixture
def hosts() -> Iterator[tuple[Host, Host]]:
    if shutil.which("ip") is None or shutil.which("nsenter") is None:
        pytest.skip("two hosts need network namespaces: there is no ip or no nsenter here")
    name = f"mvsgs{os.getpid()}"
    pair = Host(f"{name}a", "10.213.77.1"), Host(f"{name}b", "10.213.77.2")
    try:
        for host in pair:
            ip("netns", "add", host.name)
        cables = [f"v{os.getpid()}{end}" for end in "ab"]
        ip("link", "add", cables[0], "netns", pair[0].name, "type", "veth", "peer", cables[1], "netns", pair[1].name)
        for host, cable in zip(pair, cables, strict=True):
            ip("link", "set", "lo", "up", host=host)
            ip("address", "add", f"{host.address}/24", "dev", cable, host=host)
            ip("link", "set", cable, "up", host=host)
        yield pair
    finally:
        for host in pair:
            subprocess.run(["ip", "netns", "delete", host.name], check=False, capture_output=True, timeout=LONG)


def start(host: Host, spec: Path, log: Path) -> subprocess.Popen[bytes]:
    """A stage, as whoever is on that host starts it."""
    until(spec.exists)
    command = [*host.inside, sys.executable, "-m", "nodes", str(spec)]
    with log.open("ab") as said:
        return subprocess.Popen(command, env={**os.environ, **python_environment()}, stderr=said)


def test_stages_of_another_host_that_are_killed_and_started_again_lose_no_keyframe(
    hosts: tuple[Host, Host], tmp_path: Path
) -> None:
    here, there = hosts
    create_keys(tmp_path / "keys")
    (tmp_path / "graves").mkdir()
    mortal = "tests.support.mortal_stages"
    run = Launch(
        tmp_path, "dataset.options.frames=80", "dataset.size=[120,160]", "device=cpu", "mapper.iterations=2",
        "mapper.refinement=2", "evaluator.lpips=off", "evaluator.fitted=false", "screen=plain",
        "transport=tcp", f"host={here.address}", f"port={PORT}", f"keys={tmp_path / 'keys'}",
        *(word for stage, kind, after in (
            ("mvs", "Stereo", ""), ("depth_fusion", "Fusion", "mvs"), ("tracker", "Tracker", "depth_fusion")
        ) for word in (
            f"{stage}=external", f"{stage}.host={there.address}", f"{stage}._target_={mortal}.Mortal{kind}",
            f"{stage}.death.grave={tmp_path / 'graves' / stage}",
            f"{stage}.death.after={tmp_path / 'graves' / after if after else ''}",
            f"{stage}.death.arrived={tmp_path / 'graves' / 'arrived'}",
        )),
        f"dataset._target_={mortal}.PatientReader", "dataset.name=synthetic",
        f"dataset.returned={tmp_path / 'graves' / 'depth_fusion'}",
        conf=ROOT / "launch" / "conf", prefix=here.inside,
    )  # fmt: skip
    stages: dict[str, subprocess.Popen[bytes]] = {}
    deaths: list[str] = []

    def logs() -> str:
        return "".join((tmp_path / f"{name}.log").read_text() for name in stages)

    try:
        folder = folder_of(run.sockets)
        for name in ("tracker", "mvs", "depth_fusion"):
            stages[name] = start(there, folder / f"{name}.json", tmp_path / f"{name}.log")
        while run.process.poll() is None:
            assert time.time() - last_change(tmp_path) < LONG, f"nothing goes on any more: {deaths} {logs()}"
            for name, stage in stages.items():
                if stage.poll() == -signal.SIGKILL:
                    deaths.append(name)
                    stages[name] = start(there, folder / f"{name}.json", tmp_path / f"{name}.log")
                assert stage.poll() in (None, 0, -signal.SIGKILL), (tmp_path / f"{name}.log").read_text()
            time.sleep(0.05)
        out, err = run.process.communicate(timeout=LONG)
        assert run.process.returncode == 0, f"{out}{err}{deaths} {logs()}"
        assert [stage.wait(timeout=LONG) for stage in stages.values()] == [0, 0, 0]
        run.finish()
    finally:
        for stage in stages.values():
            stage.kill()
            stage.wait()
        run.kill()
    assert deaths == ["mvs", "depth_fusion", "tracker"]
    report = run.report()
    skipped = report["skipped"]
    assert report["counts"]["mapper"]["views"] > 8
    assert "keyframes that never came" not in skipped["mapper"]
    assert 0 < skipped["mapper"]["keyframes that came again"] <= report["counts"]["mapper"]["views"]
    assert skipped["tracker"]["keyframes that a killed tracker sent after it had saved its map"] <= 1
    assert (report["trajectory"]["segments"], report["counts"]["dataset"]["frames"]) == (1, 80)
    assert report["trajectory"]["ate_percent"] < 1.0
    said = [text for texts in report["warnings"].values() for text in texts]
    assert any("the tracker was started again: it goes on in its map" in text for text in said), said
    assert report["counts"]["tracker"]["frames"] >= 39  # all that came after it was killed, at frame 40
    assert any("the publisher of depth_fusion.FusedKeyframe is back after" in text for text in said), said


def folder_of(sockets: Path) -> Path:
    """Where the launcher writes what each node is told."""

    def found() -> list[Path]:
        return sorted(path for path in sockets.iterdir() if path.is_dir())

    until(found, what="the launcher did not start")
    return found()[0]


def last_change(folder: Path) -> float:
    """When something was written there last, in seconds since 1970."""
    newest = 0.0
    for inside, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                newest = max(newest, Path(inside, name).stat().st_mtime)
    return newest
