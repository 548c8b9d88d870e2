"""Hydra 1.3 under Python 3.14, whose argparse looks into every help text as it is given.

Hydra gives it one that is made only when it is printed, as that takes time, and that is no string before.
"""

from __future__ import annotations

import argparse
from typing import Any


def accept_late_help() -> None:
    """argparse leaves a help text that is no string yet unchecked, as it did before Python 3.14."""
    container: Any = argparse._ActionsContainer
    check = getattr(container, "_check_help", None)
    if check is None:
        return

    def check_text(parser: Any, action: argparse.Action) -> None:
        if isinstance(action.help, str):
            check(parser, action)

    container._check_help = check_text
