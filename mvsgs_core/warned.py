"""A list of warnings that stays short, whatever a stage meets and however long it runs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

from mvsgs_core.printable import printable

MAX_WARNINGS = 100  # distinct texts
FURTHER = "further warnings are only counted"


class Warnings(list[str]):
    """In the order of their first appearance: each text once, short and printable, and how often it came.

    Beyond `MAX_WARNINGS` texts further ones are only counted; the last line says so.
    """

    def __init__(self, texts: Iterable[str] = ()) -> None:
        super().__init__()
        self._times: dict[str, int] = {}
        self._further = 0
        self.include(texts)

    def add(self, text: str) -> None:
        line = printable(text)
        if line in self._times:
            self._times[line] += 1
        else:
            self._further += self._enter(line, 1)

    def append(self, text: str, /) -> None:
        self.add(text)

    def extend(self, texts: Iterable[str], /) -> None:
        for text in texts:
            self.add(text)

    def __iadd__(self, texts: Iterable[str], /) -> Self:  # type: ignore[override, misc]
        self.extend(texts)
        return self

    def include(self, part: Iterable[str]) -> None:
        """Those of a part as they are now. To be called as often as one likes: nothing is counted twice."""
        times, further = dict.fromkeys(map(printable, part), 1), 0
        if isinstance(part, Warnings):
            times, further = part._times, part._further
        for line, n in times.items():
            if line in self._times:
                self._times[line] = max(self._times[line], n)
            else:
                further += self._enter(line, n)
        self._further = max(self._further, further)

    def lines(self) -> list[str]:
        """For the report: how often each came, and how many further ones there were."""
        times = self._times.copy()  # another thread may add one
        lines = [text if n == 1 else f"{text} ({n} times)" for text, n in times.items()]
        return lines + ([f"and {self._further} further warnings"] if self._further else [])

    def _enter(self, line: str, n: int) -> int:
        """How many found no room."""
        if len(self._times) < MAX_WARNINGS:
            self._times[line] = n
            super().append(line)
            return 0
        if self[-1] != FURTHER:
            super().append(FURTHER)
        return n


__all__ = ["FURTHER", "MAX_WARNINGS", "Warnings"]
