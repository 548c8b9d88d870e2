"""What a browser gets of the viewer's page."""

from __future__ import annotations

import msgpack
import viser
import zstandard
from websockets.sync.client import connect
from websockets.typing import Subprotocol


def page(url: str) -> str:
    address = url.replace("http", "ws")
    got = ""
    with connect(address, subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None) as browser:
        while "ReplayDone" not in got:
            frame = browser.recv(timeout=10.0)
            assert isinstance(frame, bytes)
            length = int.from_bytes(frame[8:16], "little")  # 8 bytes: size unpacked, 8: packed, then zstd of msgpack
            metadata = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + length])
            got += str(msgpack.unpackb(metadata, strict_map_key=False, raw=False))
    return got
