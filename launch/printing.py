"""Printing that a run outlives: where its reader has ended (`| head`, or `| tee` at Ctrl-C) or a disk is full."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import IO


def say(text: str, to: IO[str] | None = None) -> bool:
    """A line, at once; on standard output unless `to` is given. Whether it could be written."""
    stream = to or sys.stdout
    try:
        print(text, file=stream, flush=True)
    except OSError:
        discard(stream)
        return False
    return True


def flush(stream: IO[str]) -> None:
    """Whatever is still to be written there."""
    try:
        stream.flush()
    except OSError:
        discard(stream)


def open_closed() -> None:
    """Standard streams that whoever started this program has closed (`>&-`) lead nowhere: no file that is opened later
    takes their place, neither here nor in a program that is started."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))


def discard(stream: IO[str]) -> None:
    """From now on nothing that is written there is kept, what waits to be written included."""
    with suppress(OSError):  # it is no file: then nothing waits
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
