"""The one error for content of a file that cannot be used, and where a parser's own errors become it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_LONGEST = 300  # characters of what a parser says


class BadFileError(ValueError):
    """A file that is damaged, hostile or not what it should be; the message names it and says what is wrong."""


@contextmanager
def reading(path: Path | str, otherwise: str) -> Iterator[None]:
    """Around the parsing of one file: whatever its content makes a parser raise leaves as `BadFileError`.

    Parsers of damaged files raise nearly anything (struct.error, KeyError, RecursionError, MemoryError, errors of their
    own), so all of it is taken here, at the file's edge, and nowhere else. otherwise: what is said of the file then, as
    in "is no transforms.json". A file that is missing or may not be read stays the OSError that it is: it names it.
    """
    try:
        yield
    except Exception as error:
        names_it = isinstance(error, BadFileError) and str(path) in str(error)
        if names_it or (isinstance(error, OSError) and str(error.filename) == str(path)):
            raise
        raise BadFileError(f"{path} {otherwise}: {brief(error)}") from error


def brief(error: BaseException) -> str:
    """What an error says, as one printable line that is not too long; its type where that says more."""
    text = str(error).strip()
    if not text or isinstance(error, KeyError | RecursionError | MemoryError):
        text = f"{type(error).__name__} {text}".strip()
    line = "".join(c if c.isprintable() else " " for c in text)
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..."
