"""What a run left out, in words: what nodes count by short names is told as what it was and what it costs."""

from __future__ import annotations

from collections.abc import Mapping

_WORDS = {  # of what the nodes of this program count
    "hypotheses outside the range": "depth hypotheses that the range of depths does not need: not tried",
    "hypotheses outside the cells": "depth hypotheses that the tracker's points rule out: not tried",
    "pixels_explored": "pixels that the map shows well already: no new splat for them",
    "splats_unseen": "splats that a view does not see: not stepped by it",
    "iterations_converged": "iterations on keyframes that are as good as they get: not made",
    "iterations_realtime": "iterations for which there was no time: not made, the map is less sharp for them",
    "images_not_saved": "keyframes whose image could not be saved: missing in exports with images",
}
_OVERTAKEN = "overtaken by a newer "


def in_words(skipped: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """From `report["skipped"]`, numbers by node and name: what it was -> how many."""
    return {
        f"{node}: {_told(what)}": f"{count:,.10g}"
        for node, of_node in skipped.items()
        for what, count in of_node.items()
        if count
    }


def _told(what: str) -> str:
    if what.startswith(_OVERTAKEN):
        slot, _, kind = what.removeprefix(_OVERTAKEN).partition(".")
        return f"messages {kind} of {slot} that a newer one overtook: not read"
    return _WORDS.get(what, what.replace("_", " "))


__all__ = ["in_words"]
