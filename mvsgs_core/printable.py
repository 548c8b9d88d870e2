"""Text from outside (a message, a file's name, an error that quotes either) made fit for a screen and a report."""

from __future__ import annotations

from collections.abc import Iterable

TEXT_LIMIT = 500  # characters


class _Escapes(dict[int, str]):
    """For `str.translate`: what of a character is shown. Those up to 255 are kept, others are looked at each time."""

    def __missing__(self, code: int) -> str:
        character = chr(code)
        return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")


_ESCAPES = _Escapes()
_ESCAPES.update({code: _ESCAPES[code] for code in range(256)})


def printable(text: object, limit: int = TEXT_LIMIT) -> str:
    """`str(text)` as one line of at most `limit` characters, without anything that a terminal obeys.

    Control characters, terminal escapes, marks that reverse the reading direction, line ends and lone surrogates
    become backslash escapes. What is cut off is counted. The work is bounded by `limit`, not by the text.
    """
    whole = text if isinstance(text, str) else str(text)
    shown = whole[:limit]
    if not shown.isprintable():
        shown = shown.translate(_ESCAPES)
    if len(whole) <= limit and len(shown) <= limit:
        return shown
    note = f"... ({len(whole)} characters)"
    return shown[: max(0, limit - len(note))] + note[:limit]


def not_utf8(names: Iterable[str]) -> str | None:
    """Of names of files, as the system gave them, what is wrong with the first that libraries in C cannot take: one
    that is no UTF-8. None: nothing is."""
    for name in names:
        try:
            name.encode("utf-8")
        except UnicodeEncodeError:
            return f"{printable(name)}: this name is no valid UTF-8; rename it, by hand or with convmv"
    return None


__all__ = ["TEXT_LIMIT", "not_utf8", "printable"]
