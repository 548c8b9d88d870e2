"""What reports and logs show of a camera's address."""

from __future__ import annotations

import pytest

from mvsgs_core.passwords import without_passwords


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("rtsp://me:secret@host/live?a=1", "rtsp://host/live?a=1"),
        ("rtsp://host/live?a=1&password=x&Token=y#f", "rtsp://host/live?a=1&password=***&Token=***#f"),
        (
            "http://host/video.cgi?user=admin&pwd=x does not answer",
            "http://host/video.cgi?user=admin&pwd=*** does not answer",
        ),
        ("rtsp://host:554/user=admin_password=x", "rtsp://host:554/user=admin_password=***"),
        ("http://host/v.cgi?loginuse=me&loginpas=x", "http://host/v.cgi?loginuse=me&loginpas=***"),
        ("https://host/v?X-Amz-Signature=x&X-Amz-Date=1", "https://host/v?X-Amz-Signature=***&X-Amz-Date=1"),
        ("http://host/v?x-api-key=x&access_key=y", "http://host/v?x-api-key=***&access_key=***"),
        ("http://host/monkey=3?keyboard=2", "http://host/monkey=3?keyboard=2"),
        ("no address: password=x", "no address: password=x"),
    ],
)
def test_an_address_is_shown_without_its_password(said: str, shown: str) -> None:
    assert without_passwords(said) == shown
    assert without_passwords({"path": [said, 3]}) == {"path": [shown, 3]}
