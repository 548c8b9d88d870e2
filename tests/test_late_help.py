"""Hydra's parser is made under Python 3.14, too, whose argparse looks into every help text as it is given."""

from __future__ import annotations

import argparse
from typing import Any

import pytest
from hydra._internal.utils import get_args_parser

from launch.late_help import accept_late_help


def check_as_of_3_14(_: Any, action: Any) -> None:
    if "%" in action.help:
        raise ValueError("badly formed help string")


def test_a_text_that_is_none_yet_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(argparse._ActionsContainer, "_check_help", check_as_of_3_14, raising=False)
    accept_late_help()
    parser: Any = get_args_parser()
    (late,) = (action for action in parser._actions if not isinstance(action.help or "", str))
    parser._check_help(late)
    late.help = "100 %"
    with pytest.raises(ValueError, match="badly formed"):
        parser._check_help(late)
