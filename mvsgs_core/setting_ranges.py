"""Ranges of settings: a configuration refuses what lies outside, in words that name the setting."""

from __future__ import annotations

SEEDS = (0, 2**32 - 1)  # what NumPy takes
LARGEST = SEEDS[1]  # of an integer: more is no number of anything that is counted here
# beside a type, as in Annotated[float, UNBOUNDED]: a setting may be infinite, or an integer beyond LARGEST, as far as
# its own range goes; where a default is so large, it need not be said
UNBOUNDED = "unbounded"


def at_least(config: object, **least: float) -> None:
    """Raises ValueError for a setting below what is given here for it, or NaN; None is as good as not given."""
    for name, low in least.items():
        value = getattr(config, name)
        if value is not None and not value >= low:
            raise ValueError(f"{name}={value}: must be {low} or more")


def above(config: object, **bounds: float) -> None:
    """Raises ValueError for a setting that is not above what is given here for it; None is as good as not given."""
    for name, bound in bounds.items():
        value = getattr(config, name)
        if value is not None and not value > bound:
            raise ValueError(f"{name}={value}: must be above {bound}")


def within(config: object, **ranges: tuple[float, float]) -> None:
    """Raises ValueError for a setting outside of [low, high], or NaN; None is as good as not given."""
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if value is not None and not low <= value <= high:
            raise ValueError(f"{name}={value}: must be from {low} to {high}")


__all__ = ["LARGEST", "SEEDS", "UNBOUNDED", "above", "at_least", "within"]
