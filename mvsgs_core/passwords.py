"""Addresses with a user and a password (rtsp://user:password@host) as reports and logs may show them."""

from __future__ import annotations

import re
from typing import Any

_USER = re.compile(r"://[^/?#\s]*@")


def without_passwords(value: Any) -> Any:
    """A text, or all texts in a report, with addresses that name no user."""
    if isinstance(value, str):
        return _USER.sub("://", value)
    if isinstance(value, dict):
        return {key: without_passwords(item) for key, item in value.items()}
    return [without_passwords(item) for item in value] if isinstance(value, list) else value
