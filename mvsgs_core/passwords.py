"""A camera's address with a password (rtsp://user:password@host, http://host/video?pwd=...), as reports may show it."""

from __future__ import annotations

import re
from typing import Any

_USER = re.compile(r"://[^/?#\s]*@")
_ADDRESS = re.compile(r"://\S+")
_WORDS = "pass|password|passwd|passphrase|pas|pwd|psw|pw|token|secret|signature|auth|apikey"  # names end in
_SECRET = re.compile(rf"([?&;_/](?:[\w.-]*(?:{_WORDS})|(?:[\w.-]*[._-])?(?:key|sig))=)[^&;#\s]+", re.IGNORECASE)


def without_passwords(value: Any) -> Any:
    """A text, or all texts in a report, with addresses that name no user and hide what is secret in their query."""
    if isinstance(value, str):
        return _ADDRESS.sub(lambda address: _SECRET.sub(r"\1***", address[0]), _USER.sub("://", value))
    if isinstance(value, dict):
        return {key: without_passwords(item) for key, item in value.items()}
    return [without_passwords(item) for item in value] if isinstance(value, list) else value
