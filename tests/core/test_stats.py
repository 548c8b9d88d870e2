"""What a stage counts and warns of stays short, whatever it meets."""

from __future__ import annotations

import time

from mvsgs_core.printable import printable
from mvsgs_core.stats import Stats
from mvsgs_core.warned import FURTHER, MAX_WARNINGS, Warnings


def test_the_same_warning_is_one_line_with_a_count() -> None:
    stats = Stats()
    for text in ("blurred", "lost", "blurred", "blurred"):
        stats.warn(text)
    assert stats.warnings == ["blurred", "lost"]  # as it is shown while the run goes on: a line once
    assert stats.warnings.lines() == ["blurred (3 times)", "lost"]


def test_a_warning_added_as_to_any_list_is_kept_and_counted() -> None:
    stats = Stats()
    stats.warnings.append("a\x1b[2J")
    stats.warnings += ["b", "b"]
    stats.warnings.extend(str(i) for i in range(1000))
    assert stats.warnings.lines()[:2] == [r"a\x1b[2J", "b (2 times)"]
    assert len(stats.warnings.lines()) == MAX_WARNINGS + 1


def test_thousands_of_long_warnings_cost_neither_time_nor_memory() -> None:
    texts = [f"{i} " + "\x00" * 59_000 for i in range(1000)]
    stats = Stats()
    began = time.process_time()
    for i in range(20_000):
        stats.warn(texts[i % 1000])
    assert time.process_time() - began < 2.0  # every text compared with every other takes a minute
    assert len(stats.warnings) == MAX_WARNINGS + 1
    assert stats.warnings[-1] == FURTHER
    lines = stats.warnings.lines()
    assert lines[-1] == f"and {900 * 20} further warnings"
    assert lines[0].startswith("0 \\x00\\x00")
    assert lines[0].endswith("(59002 characters) (20 times)")
    assert max(map(len, lines)) < 520


def test_a_part_may_be_included_again_and_again() -> None:
    part, whole = Stats(), Stats()
    whole.warn("own")
    for number in range(3):
        part.count("frames")
        part.warn("lost")
        for i in range(MAX_WARNINGS):
            part.warn(f"{number} {i}")
        whole.include(part)
        whole.include(part)
    assert whole.counts == {"frames": 3}
    lines = whole.warnings.lines()
    assert lines[:2] == ["own", "lost (3 times)"]
    assert len(lines) == MAX_WARNINGS + 1
    assert lines[-1] == f"and {3 * MAX_WARNINGS + 2 - MAX_WARNINGS} further warnings"
    readers = Warnings()
    for _ in range(2):
        readers.include(["a list that grows", "elsewhere"])
    assert readers.lines() == ["a list that grows", "elsewhere"]


def test_nothing_to_show_is_a_value_with_its_reason() -> None:
    stats = Stats()
    stats.nothing("no texture: 3 points a frame")
    assert stats.values == {"nothing": "no texture: 3 points a frame"}


def test_shown_text_is_one_line_that_no_terminal_obeys() -> None:
    assert printable("Schnee im März, 4 × 4 雪") == "Schnee im März, 4 × 4 雪"
    assert printable("a\x1b]0;owned\x07\x1b[2J\r\nb\u202e\ud800\x9b") == (
        r"a\x1b]0;owned\x07\x1b[2J\r\nb\u202e\ud800\x9b"
    )
    assert printable(ValueError("x\ty")) == r"x\ty"
    cut = printable("\x1b" * 10_000_000, limit=80)
    assert len(cut) == 80
    assert cut.endswith(r"... (10000000 characters)")
    assert cut.isprintable()
    assert len(printable("ab" * 30, limit=5)) == 5
    assert len(printable("\x00" * 400)) == 500
