"""What got slower or worse than the recorded quick line, by more than the noise.

    python -m bench.compare runs/bench-quick/*.json

Figures are matched by benchmark (the file's name) and row. Each kind of figure has a noise, below which a change says
nothing, and a bound, beyond which it is a regression and the exit code is 1; so is a goal that is no longer met by more
than the noise, and a number that is none any more, and a row that is gone, unless a row says that its subject is
skipped. Times, rates and memory are compared with wide tolerances, and only warn where the machine is another than the
recorded one; ratios and errors hold anywhere.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.record import RECORDED, Record, read_rows
from bench.table import SKIPPED, is_skipped
from mvsgs_core.evaluation.metrics import DEPTH, IMAGE, TRAJECTORY
from mvsgs_core.machine import processor


@dataclass(frozen=True)
class Tolerance:
    """`noise` and `bound` are factors (1.3: 30 % worse), or for `absolute` differences in the figure's unit."""

    noise: float
    bound: float
    higher_is_better: bool
    absolute: bool = False
    machine_bound: bool = False  # says nothing about another machine
    floor: float = 0.0  # values up to this are all the same: nothing is measured below


_UNITS = {
    "dB": Tolerance(0.3, 1.0, True, absolute=True),
    "s": Tolerance(1.4, 2.5, False, machine_bound=True, floor=0.05),
    "ms": Tolerance(1.4, 2.5, False, machine_bound=True, floor=0.05),
    "ms/keyframe": Tolerance(1.4, 2.5, False, machine_bound=True, floor=0.05),
    "MB/s": Tolerance(1.4, 2.5, True, machine_bound=True),
    "1/s": Tolerance(1.4, 2.5, True, machine_bound=True),
    "MB": Tolerance(1.2, 1.6, False, machine_bound=True, floor=20.0),
}
_RATIO = 1.5, 2.5  # of two figures of one run: the machine is out of it, its other work is not
_ATE = Tolerance(1.5, 3.0, False, floor=1e-3)
_METRICS = {  # by key; of others the direction says it
    "ssim": Tolerance(0.01, 0.04, True, absolute=True),
    "lpips": Tolerance(0.01, 0.04, False, absolute=True),
    "ate_rmse": _ATE,
    "ate_percent": _ATE,
}
_DIRECTIONS = {  # parts of a whole differ by so much, errors by a factor
    "higher": Tolerance(0.03, 0.1, True, absolute=True),
    "lower": Tolerance(1.3, 2.0, False, floor=1e-6),
}
_WORDS = {  # of a figure's name, for those that only benchmarks measure
    r"outliers?": Tolerance(0.02, 0.1, False, absolute=True),
    r"errors?": _DIRECTIONS["lower"],
    r"wall (s|time)": _UNITS["s"],
    r"seconds": _UNITS["s"],
}
_NAMED = {
    **{
        rf"{re.escape(metric.label.lower())}(ness)?": _METRICS.get(metric.key, _DIRECTIONS[metric.better])
        for metric in (*IMAGE, *DEPTH, *TRAJECTORY)
        if metric.better
    },
    **_WORDS,
}


def tolerance(row: dict[str, Any]) -> Tolerance | None:
    """How a figure is compared; None where nothing says which way is better.

    A goal says it for the row that has one: a ratio of outliers may be the better the higher it is, a difference in dB
    the lower.
    """
    figure = row["name"].rpartition(": ")[2].lower()
    known = _of_unit(row["unit"])
    ratio = row["unit"] == "x" or re.search(r" / | over ", figure)  # says nothing without a goal
    if known is None and not ratio:
        known = next((rule for words, rule in _NAMED.items() if re.search(rf"\b{words}(?!\w)", figure)), None)
    if row["goal"][:2] not in ("<=", ">="):
        return known
    higher = row["goal"].startswith(">=")
    return replace(known, higher_is_better=higher) if known else Tolerance(*_RATIO, higher_is_better=higher)


def _of_unit(unit: str) -> Tolerance | None:
    """Of the whole unit, or of the first word of one such as "ms/image", "s CPU" or "ms, median"."""
    word = re.split(r"[ ,]", unit)[0]
    return _UNITS.get(unit) or _UNITS.get(word) or _UNITS.get(word.partition("/")[0])


@dataclass(frozen=True)
class Change:
    """A figure that is worse (or better) by more than the noise."""

    name: str
    before: str
    now: str
    worse: bool
    regression: bool
    note: str = ""


def change(row: dict[str, Any], before: dict[str, Any], same_machine: bool) -> Change | None:
    """None where the figure says nothing, or nothing new."""
    name, now, then = row["name"], row["value"], before["value"]
    new, old, rule = _number(now), _number(then), tolerance(row)
    missed = row["met"] is False and before["met"] is True
    if old is not None and new is None:
        return Change(name, _text(then, row), str(now), True, True, "no figure any more")
    if missed and (new is None or rule is None):
        return Change(name, str(then), str(now), True, True, "goal no longer met")
    if new is None or old is None:
        return None
    if not math.isfinite(new) or not math.isfinite(old):
        if math.isfinite(new) == math.isfinite(old):
            return None
        worse = not math.isfinite(new)
        return Change(name, _text(then, row), _text(now, row), worse, worse, "not finite" if worse else "finite again")
    if rule is None:
        return None
    spread = float(before.get("spread") or 0.0)
    if rule.absolute:
        worse_by = (old - new) if rule.higher_is_better else (new - old)
        noise, bound = rule.noise + 2 * spread, rule.bound + 2 * spread
        amount = f"{new - old:+.3g}"
    else:
        low, high = (new, old) if rule.higher_is_better else (old, new)
        floor = rule.floor or 1e-12
        ratio = max(high, floor) / max(low, floor)
        worse_by = ratio if ratio >= 1 else -1 / ratio
        widening = 1 + 2 * spread / max(abs(old), floor)
        noise, bound = rule.noise * widening, rule.bound * widening
        amount = f"{new / old:.2f} times" if old else ""
    if abs(worse_by) <= noise:
        return None
    regression = worse_by > (noise if missed else bound) and (same_machine or not rule.machine_bound)
    amount += ", goal no longer met" if missed else ""
    return Change(name, _text(then, row), _text(now, row), worse_by > 0, regression, amount)


def compare(name: str, rows: list[dict[str, Any]], recorded: Record) -> list[Change]:
    """Changes of one benchmark; a row that is gone is one, a regression, but for those that are skipped."""
    same = recorded.machine == processor()
    before = {row["name"]: row for row in recorded.rows}
    now = {row["name"]: row for row in rows}
    skipped = [key.removesuffix(SKIPPED) for key in now if is_skipped(key)]
    found = [change(row, before[key], same) for key, row in now.items() if key in before]
    changes = [c for c in found if c is not None]
    changes += [
        Change(key, _text(row["value"], row), "gone", True, True, "the row is missing")
        for key, row in before.items()
        if key not in now and not any(_is_of(key, subject) for subject in skipped)
    ]
    return changes


def _is_of(name: str, subject: str) -> bool:
    """Whether a row's name has, among its parts, what the subject's begins with: of "fr1_xyz, raft_small" are
    "fr1_xyz: keyframes" and "parts, fr1_xyz, tracked: inliers"."""
    return subject.partition(", ")[0] in re.split(r": |, |/", name)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _text(value: Any, row: dict[str, Any]) -> str:
    return f"{value:.4g} {row['unit']}".strip() if isinstance(value, float) else str(value)


def run(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, help="rows of the quick benchmarks, from --json")
    parser.add_argument("--recorded", type=Path, default=RECORDED / "quick", help="folder of the recorded line")
    options = parser.parse_args(arguments)
    regressions = worse = better = compared = 0
    for file in options.files:
        known = options.recorded / f"{file.stem}.json"
        if not known.exists():
            print(f"{file.stem}: nothing recorded to compare with")
            continue
        recorded = Record.load(file.stem, options.recorded)
        rows = read_rows([file])[0]
        compared += len(rows)
        changes = compare(file.stem, rows, recorded)
        skipped = [row for row in rows if is_skipped(row["name"])]
        if changes or skipped:
            print(f"{file.stem} (recorded at {recorded.commit}, {recorded.date}, {recorded.machine})")
        for c in sorted(changes, key=lambda c: (not c.regression, not c.worse)):
            word = "REGRESSION" if c.regression else "worse" if c.worse else "better"
            print(f"  {word:10}  {c.name}: {c.before} -> {c.now}  {c.note}")
        for row in skipped:
            print(f"  not compared: {row['name']}: {row['value']}")
        regressions += sum(c.regression for c in changes)
        worse += sum(c.worse and not c.regression for c in changes)
        better += sum(not c.worse for c in changes)
    print(f"{compared} figures: {regressions} regressions, {worse} worse within bounds, {better} better")
    return 1 if regressions else 0


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
