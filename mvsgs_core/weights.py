"""One registry of network weights: where each file is found, where it can be had, and whether it is the right one.

    python -m mvsgs_core.weights list
    python -m mvsgs_core.weights fetch lpips_squeeze_head
    python -m mvsgs_core.weights check FILE

A file is looked for in the folders of $MVSGS_WEIGHTS (separated like $PATH), then in the user's cache.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import DownloadColumn, Progress, TransferSpeedColumn

from mvsgs_core.cache_folder import cache_folder

_BLOCK = 1 << 20  # bytes
_HEAD = 512  # bytes that tell what a file is


@dataclass(frozen=True)
class Weights:
    """A published file of weights. `sha256` is None where the publisher states none and we could not see the file."""

    name: str
    files: tuple[str, ...]  # names under which it is looked for, the first being ours
    network: str
    license: str
    page: str  # where it can be had by hand
    size: int | None = None  # bytes
    sha256: str | None = None
    url: str | None = None  # direct download; None: only by hand


REGISTRY = {
    w.name: w
    for w in (
        Weights(
            "lpips_squeeze_trunk", ("lpips_squeezenet1_1_features.pth",), "SqueezeNet 1.1 features for LPIPS", "BSD-2",
            "https://github.com/delldu/LPIPS",
            2_899_197, "435cedb387e95bc8291893f61a3a64f0345b8c23a05139aceef43947efb3d52d",
        ),
        Weights(
            "lpips_squeeze_head", ("lpips_v0.1/squeeze.pth", "squeeze.pth"), "LPIPS v0.1 linear heads, SqueezeNet",
            "BSD-2", "https://github.com/richzhang/PerceptualSimilarity",
            10_811, "4a5350f23600cb79923ce65bb07cbf57dca461329894153e05a1346bd531cf76",
            "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/squeeze.pth",
        ),
        Weights(
            "raft_small", ("raft-small.pth",), "RAFT, small model", "BSD-3",
            "https://github.com/princeton-vl/RAFT (download_models.sh)",
            3_984_814, "c7d41b9cc88442bb8aa911dbb33086dac55a226394b142937ff22d5578717332",
        ),
        Weights(
            "itermvs", ("itermvs_blendedmvs.ckpt", "model_000015.ckpt"), "IterMVS, trained on BlendedMVS", "MIT",
            "https://github.com/FangjinhuaWang/IterMVS",
            4_177_299, "8563268624cf203750212a0e0bfa4825a5af05c0005a225ef02f138258b0fc42",
            "https://github.com/FangjinhuaWang/IterMVS/raw/main/checkpoints/blendedmvs/model_000015.ckpt",
        ),
        Weights(
            "droid", ("droid.pth",), "DROID-SLAM", "BSD-3",
            "https://github.com/princeton-vl/DROID-SLAM (Google Drive link in its README)",
        ),
        Weights(
            "mvsformer", ("mvsformer.pth",), "MVSFormer, Twins backbone", "Apache-2.0",
            "https://github.com/ewrfcas/MVSFormer (OneDrive link in its README)",
        ),
        Weights(
            "mvsformer_p", ("mvsformer-p.pth",), "MVSFormer-P, frozen DINO backbone", "Apache-2.0",
            "https://github.com/ewrfcas/MVSFormer (OneDrive link in its README)",
        ),
        Weights(
            "vfuse", ("vfuse.pth",), "V-FUSE (released for other MVS networks, none for MVSFormer)",
            "none stated: all rights reserved",
            "https://github.com/nburgdorfer/V-FUSE (SharePoint link in its README)",
        ),
    )
}  # fmt: skip


def folders() -> list[Path]:
    """Folders that are searched, in order: those that are given, then the cache that `fetch` writes to."""
    given = [Path(p) for p in os.environ.get("MVSGS_WEIGHTS", "").split(os.pathsep) if p]
    cache = cache_folder()
    return [*given, cache / "weights"] if cache else given


def find(name: str, file: str | Path | None = None) -> Path:
    """Path of the weights `name`: `file` if given, else the first found in `folders()`.

    Raises KeyError for an unknown name and FileNotFoundError, saying what to fetch from where.
    """
    weights = _entry(name)
    if file is not None:
        if not Path(file).is_file():
            raise FileNotFoundError(f"weights of {weights.network}: there is no file {file}")
        return Path(file)
    for folder in folders():
        for candidate in weights.files:
            if (folder / candidate).is_file():
                return folder / candidate
    raise FileNotFoundError(missing(weights))


def missing(weights: Weights) -> str:
    """What to do about weights that are not there."""
    return (
        f"no weights of {weights.network} ({weights.files[0]}) in {_searched()}: {remedy(weights.name)}, "
        "or set MVSGS_WEIGHTS to the folder that holds them"
    )


def _searched() -> str:
    return ", ".join(str(f) for f in folders()) or "no folder (MVSGS_WEIGHTS is not set, and there is no home)"


def remedy(name: str) -> str:
    """How to come by weights, to end an error message with. Raises KeyError for an unknown name."""
    weights = _entry(name)
    return f"python -m mvsgs_core.weights fetch {name}" if weights.url else f"get it from {weights.page}"


def checksum(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    digest = hashlib.sha256()
    with file.open("rb") as data:
        while block := data.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def is_web_page(file: Path) -> bool:
    """Whether a file is HTML or XML: what a download gives where the link leads to a question, not to the weights."""
    with file.open("rb") as data:
        return data.read(_HEAD).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def check(file: Path) -> str:
    """Says which registered weights a file is. Raises FileNotFoundError, or ValueError if it is none of them."""
    if not file.is_file():
        raise FileNotFoundError(f"there is no file {file}: python -m mvsgs_core.weights list shows what there is")
    if is_web_page(file):
        raise ValueError(f"{file}: a web page, no weights, as comes where a link asks something first: use a browser")
    digest = checksum(file)
    for weights in REGISTRY.values():
        if weights.sha256 == digest:
            return f"{file}: {weights.name} ({weights.network}), intact"
    named = [w for w in REGISTRY.values() if file.name in {Path(f).name for f in w.files}]
    if named and named[0].sha256 is None:
        return f"{file}: named as {named[0].name}; its publisher states no checksum (SHA-256 {digest})"
    if not named:
        raise ValueError(f"{file}: SHA-256 {digest} is none of the registered weights ({', '.join(REGISTRY)})")
    right, size = named[0], file.stat().st_size
    what = "another file"
    if right.size and size < right.size:
        what = f"truncated ({size} of {right.size} bytes) or another file"
    raise ValueError(f"{file}: SHA-256 {digest}, but {right.name} has {right.sha256}: {what}; {remedy(right.name)}")


def fetch(name: str, timeout: float = 30.0) -> Path:
    """Downloads weights into the cache, going on where an earlier try stopped, and verifies them.

    Raises ValueError where they can only be had by hand, arrive wrong or have no place to lie, and ConnectionError
    without network.
    """
    weights = _entry(name)
    cache = cache_folder()
    if cache is None:
        raise ValueError("no home folder to keep weights in: set XDG_CACHE_HOME to a folder (an absolute path)")
    target = cache / "weights" / weights.files[0]
    if target.is_file() and (weights.sha256 is None or checksum(target) == weights.sha256):
        return target
    if weights.url is None:
        raise ValueError(f"{name} cannot be downloaded by a program: get it from {weights.page}, save it as {target}")
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    try:
        _download(weights.url, part, weights.size, timeout)
    except (urllib.error.URLError, TimeoutError, OSError) as error:
        if isinstance(error, urllib.error.HTTPError):
            error.close()  # it is the server's answer, too, which holds the connection
        raise ConnectionError(
            f"{weights.url}: {error}; what has arrived is kept, try again, or: {weights.page}"
        ) from error
    if weights.sha256 is not None and checksum(part) != weights.sha256:
        part.unlink()
        raise ValueError(
            f"{weights.url} gave another file than expected (checksum): it is not kept; see {weights.page}"
        )
    part.replace(target)
    return target


def _download(url: str, part: Path, size: int | None, timeout: float) -> None:
    have = part.stat().st_size if part.exists() else 0
    if have and size is not None and have >= size:
        return  # all of it came in an earlier try, which ended before it was verified
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    with urllib.request.urlopen(request, timeout=timeout) as response:
        resumed = response.status == 206
        total = int(response.headers.get("Content-Length") or 0) + (have if resumed else 0)
        columns = (*Progress.get_default_columns(), DownloadColumn(), TransferSpeedColumn())
        with part.open("ab" if resumed else "wb") as out, Progress(*columns, console=Console(stderr=True)) as progress:
            task = progress.add_task(
                part.name.removesuffix(".part"), total=total or None, completed=have if resumed else 0
            )
            while block := response.read(_BLOCK):
                out.write(block)
                progress.advance(task, len(block))
    if total and part.stat().st_size != total:
        raise OSError(f"only {part.stat().st_size} of {total} bytes arrived")


def _entry(name: str) -> Weights:
    if name not in REGISTRY:
        raise KeyError(f"no weights {name!r}; there are: {', '.join(REGISTRY)}")
    return REGISTRY[name]


def _show() -> None:
    """What can be copied, places and addresses, has lines of its own that nothing cuts or folds."""
    for weights in REGISTRY.values():
        try:
            place = str(find(weights.name))
        except FileNotFoundError:
            place = "not found"
        size = f"{weights.size / 1e6:.2f} MB" if weights.size else "size unknown"
        print(f"{weights.name}: {weights.network}; {weights.license}; {size}")
        print(f"  here: {place}\n  from: {weights.url or weights.page}")
    print(f"looked for in {_searched()}; MVSGS_WEIGHTS adds folders")


def main(words: list[str] | None = None, prog: str = "python -m mvsgs_core.weights") -> int:
    parser = argparse.ArgumentParser(prog=prog, description="Network weights")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="all registered weights and where they are found")
    commands.add_parser("fetch", help="download one").add_argument("name")
    commands.add_parser("check", help="say which weights a file holds").add_argument("file", type=Path)
    arguments = parser.parse_args(words)
    try:
        if arguments.command == "list":
            _show()
        elif arguments.command == "fetch":
            print(fetch(arguments.name))
        else:
            print(check(arguments.file))
    except (OSError, ValueError, KeyError) as error:
        print(f"error: {error.args[0] if isinstance(error, KeyError) else error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
