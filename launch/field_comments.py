"""The comments that stand beside a dataclass's fields, read from its source: they are written once, there."""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
from dataclasses import is_dataclass


def field_comments(config: type) -> dict[str, str]:
    """Field name -> the comment after it, or that in the lines right above it; fields without one are left out."""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__):
        if is_dataclass(kind):
            found |= _own_comments(kind)
    return found


def _own_comments(config: type) -> dict[str, str]:
    try:
        source = textwrap.dedent(inspect.getsource(config))
    except (OSError, TypeError):  # made without a file
        return {}
    comments = {  # by line: what it says, and whether the line has nothing else
        token.start[0]: (token.string.lstrip("# ").rstrip(), token.line.lstrip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for statement in definition.body:
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            own = range(statement.lineno, (statement.end_lineno or statement.lineno) + 1)
            lines = [comments[line][0] for line in own if line in comments]
            above = statement.lineno - 1
            while not set(own) & comments.keys() and above in comments and comments[above][1]:
                lines.insert(0, comments[above][0])
                above -= 1
            if lines:
                found[statement.target.id] = " ".join(lines)
    return found
