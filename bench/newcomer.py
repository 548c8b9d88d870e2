"""From nothing to a map of one's own video: `make wheel`, then `python -m bench.newcomer`.

With the wheel, where no compiler is found, and with a clone of the checkout: a new virtual environment, an empty home,
the commands that README names. Then what people get wrong: each must be refused in one line, before a process starts.
`--quick`: the wheel alone, with this environment's packages in place of a download.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import venv
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np

from bench.runs import ROOT
from bench.table import Row, all_of, at_least, at_most, main
from mvsgs_core.datasets import open_dataset

COMPILERS = ("cc", "gcc", "g++", "c++", "clang", "clang++", "make", "cmake", "ninja", "ld", "as", "nvcc")
VIDEO, FRAMES = "walk.mp4", 90
MAX_COMMANDS, MIN_PSNR, MAX_REFUSAL = 2, 25.0, 15.0  # commands, dB, seconds
WRONG = (  # what is typed, and what the one line must name
    (["wolk.mp4"], "wolk.mp4"),
    (["empty"], "empty"),
    (["notes.mp4"], "notes.mp4"),
    (["photso"], "photos"),
    (["photos/0.png"], "folder"),
    ([VIDEO, "mapper.iteration=3"], "iterations"),
    ([VIDEO, "tracker=droit"], "droid"),
    ([VIDEO, "device=cuda:7"], "cuda:7"),
    ([VIDEO, "dataset.intrinsics=[1,2,3]"], "fx, fy, cx, cy"),
    (["77"], "video77"),
)


@dataclass(frozen=True)
class Newcomer:
    """Somebody's machine: a folder that holds their home and their files, and the programs they find."""

    root: Path
    path: str
    typed: list[str] = field(default_factory=list)  # commands that had to succeed

    @staticmethod
    def at(root: Path, *, compiler: bool) -> Newcomer:
        for name in ("home", "tmp", "work/empty", "work/photos"):
            (root / name).mkdir(parents=True)
        if compiler:
            return Newcomer(root, os.environ["PATH"])
        programs = root / "bin"  # those of the system, without what compiles
        programs.mkdir()
        for folder in map(Path, ("/bin", "/usr/bin", str(Path(sys.base_prefix) / "bin"))):
            for program in folder.iterdir():
                name = program.name.rpartition("linux-gnu-")[2].partition("-")[0]
                if name not in COMPILERS and not (programs / program.name).is_symlink():
                    (programs / program.name).symlink_to(program)
        return Newcomer(root, str(programs))

    @property
    def work(self) -> Path:
        return self.root / "work"

    def types(self, *words: object, cwd: Path | None = None) -> tuple[subprocess.CompletedProcess[str], float]:
        """A command, and how many seconds it took."""
        kept = ("PIP_", "LANG", "SSL_", "REQUESTS_", "http", "HTTP", "no_proxy", "NO_PROXY")
        known = {name: value for name, value in os.environ.items() if name.startswith(kept)}
        mine = {"HOME": str(self.root / "home"), "TMPDIR": str(self.root / "tmp"), "PATH": self.path}
        begun = time.perf_counter()
        done = subprocess.run(
            [str(word) for word in words],
            cwd=cwd or self.work,
            env=known | mine,
            capture_output=True,
            text=True,
            check=False,
        )
        return done, time.perf_counter() - begun

    def must(self, *words: object, cwd: Path | None = None) -> float:
        """Seconds of a command that has to succeed. Raises RuntimeError with its last words."""
        self.typed.append(" ".join(map(str, words)))
        done, seconds = self.types(*words, cwd=cwd)
        if done.returncode:
            last = "\n".join((done.stdout + done.stderr).splitlines()[-20:])
            raise RuntimeError(f"{self.typed[-1]}: exit code {done.returncode}\n{last}")
        return seconds


def record_video(path: Path) -> None:
    """What their phone took: a walk through the synthetic room, H.264, the camera unknown."""
    items = list(open_dataset("synthetic", frames=FRAMES, threads=1))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "18"})
        (stream.height, stream.width), stream.pix_fmt = items[0].image.shape[:2], "yuv420p"
        for item in items:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(item.image, format="rgb24")))
        container.mux(stream.encode())


def files_of(work: Path, video: Path) -> None:
    shutil.copy(video, work / VIDEO)
    (work / "notes.mp4").write_text("no video")
    for n, item in zip(range(3), open_dataset("synthetic", frames=3, threads=1)):
        av.VideoFrame.from_ndarray(item.image, format="rgb24").to_image().save(work / "photos" / f"{n}.png")


def size_of(folder: Path) -> float:
    """GB."""
    return 1e-9 * sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and not file.is_symlink())


def rows_of_map(name: str, who: Newcomer, command: Path, set_up: float, packages: Path) -> list[Row]:
    """They map their video."""
    took = who.must(command, VIDEO, "output=mine")
    report = json.loads((who.work / "mine" / "report.json").read_text())
    there = [file for file in ("map.ply", "report.html", "cameras.json") if (who.work / "mine" / file).is_file()]
    return [
        at_most(f"{name}: commands until a map can be looked at", float(len(who.typed)), "", MAX_COMMANDS),
        Row(f"{name}: setting up", set_up / 60.0, "min"),
        Row(f"{name}: mapping {FRAMES} frames of their video", took / 60.0, "min"),
        Row(f"{name}: installed", size_of(packages), "GB"),
        all_of(f"{name}: map, report and cameras", len(there), 3),
        at_least(f"{name}: held-out PSNR", report["rendering"]["held_out"]["psnr"], "dB", MIN_PSNR),
    ]


def rows_of_refusals(name: str, who: Newcomer, command: Path) -> list[Row]:
    fine, slowest = 0, 0.0
    for words, named in WRONG:
        done, seconds = who.types(command, *words)
        lines = done.stderr.splitlines()
        one = done.returncode == 2 and len(lines) == 1 and named in lines[0] and not (who.work / "runs").exists()
        if not one:
            print(f"mvsgs {' '.join(words)}: exit code {done.returncode}: {lines}", flush=True)
        fine, slowest = fine + one, max(slowest, seconds)
    return [
        all_of(f"{name}: wrong inputs refused in one line that names what to do", fine, len(WRONG)),
        at_most(f"{name}: the slowest refusal", slowest, "s", MAX_REFUSAL),
    ]


def with_wheel(root: Path, wheel: Path, video: Path, quick: bool) -> list[Row]:
    who = Newcomer.at(root, compiler=False)
    files_of(who.work, video)
    environment = who.work / ".venv"
    venv.create(environment, with_pip=True, symlinks=True)
    if quick:
        (packages,) = (environment / "lib").glob("python*/site-packages")
        (packages / "borrowed.pth").write_text(str(Path(np.__file__).parents[1]) + "\n")
    found = shutil.which("cc", path=who.path) or shutil.which("g++", path=who.path)
    if found:
        raise RuntimeError(f"a compiler is there: {found}")
    install = [environment / "bin/python", "-m", "pip", "install", "--quiet", *(["--no-deps"] if quick else []), wheel]
    set_up = who.must(*install)
    command = environment / "bin/mvsgs"
    return [*rows_of_map("wheel", who, command, set_up, environment), *rows_of_refusals("wheel", who, command)]


def with_checkout(root: Path, video: Path) -> list[Row]:
    who = Newcomer.at(root, compiler=True)
    files_of(who.work, video)
    clone = who.work / "mvs-gs"
    subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
    set_up = who.must("make", "setup", cwd=clone)
    command = clone / ".venv/bin/mvsgs"
    name = "checkout"
    return [*rows_of_map(name, who, command, set_up, clone / ".venv"), *rows_of_refusals(name, who, command)]


def newest_change(checkout: Path) -> float:
    """When, in seconds since 1970, what a wheel is made of changed last: by a commit, or a file that differs from it;
    0 where nothing is under version control."""
    project = tomllib.loads((checkout / "pyproject.toml").read_text())
    packages = project["tool"]["scikit-build"]["wheel"]["packages"].values()

    def git(*words: str) -> list[str]:
        command = ["git", "-C", str(checkout), *words, "--", "CMakeLists.txt", "pyproject.toml", *packages]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()

    committed = [float(seconds) for seconds in git("log", "-1", "--format=%ct")]
    names = [*git("diff", "--name-only", "HEAD"), *git("ls-files", "--others", "--exclude-standard")]
    changed = [file.stat().st_mtime for name in names if (file := checkout / name).is_file()]
    return max(committed + changed, default=0.0)


def measure(options: argparse.Namespace) -> list[Row]:
    built = sorted((ROOT / "dist").glob("mvsgs-*.whl"), key=lambda file: file.stat().st_mtime)
    wheel = (options.wheel or (built[-1] if built else ROOT / "dist")).absolute()
    if not wheel.is_file():
        raise SystemExit(f"{wheel}: there is no wheel; `make wheel` builds one")
    if wheel.stat().st_mtime < newest_change(ROOT):
        raise SystemExit(f"{wheel}: older than what it is made of; `make wheel` builds one of this commit")
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / VIDEO
        record_video(video)
        rows = with_wheel(Path(folder) / "wheel", wheel, video, options.quick)
        shutil.rmtree(Path(folder) / "wheel")
        return rows if options.quick else [*rows, *with_checkout(Path(folder) / "checkout", video)]


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--wheel", type=Path, help="what `make wheel` built; default: the newest in dist/")


if __name__ == "__main__":
    main(measure, "A newcomer", arguments)
