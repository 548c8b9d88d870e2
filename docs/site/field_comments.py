"""For the reference: a field's comment in the source is its description, as `--help` shows it."""

from __future__ import annotations

import io
import tokenize
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """The comment after a field, or in the lines right above it, where it has no docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        if attr.docstring is not None or attr.lineno is None or attr.endlineno is None:
            return
        lines = attr.lines_collection[attr.filepath]
        found = [text for line in lines[attr.lineno - 1 : attr.endlineno] if (text := _comment(line))]
        above = attr.lineno - 2
        while not found[:1] and above >= 0 and lines[above].lstrip().startswith("#"):
            above -= 1
        text = " ".join(found or [line.strip(" #") for line in lines[above + 1 : attr.lineno - 1]])
        if text:
            attr.docstring = griffe.Docstring(text[0].upper() + text[1:], parent=attr)


def _comment(line: str) -> str:
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(line.strip()).readline))
    except (tokenize.TokenError, SyntaxError):  # a bracket that the next line closes
        return ""
    return next((token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT), "")
