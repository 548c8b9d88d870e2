"""A publisher and a reader with a long, fast link between them: `python -m tests.support.long_link FOLDER`.

Two network namespaces, each with a device whose packets this program carries to the other one, `DELAY` later. Prints
how many of the frames came; exit code 77 where namespaces are not permitted. FOLDER takes the keys.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from msgs import End, Frame
from nodes.runtime.addresses import Keys
from nodes.runtime.transport import LivePublisher, LiveReader, create_keys

COUNT, INTERVAL = 60, 1 / 30  # frames of nearly a megabyte: 28 MB/s
DELAY = 0.02  # s one way
NOT_PERMITTED = 77
PUBLISHER, READER = "10.9.0.1", "10.9.0.2"
ADDRESS = f"tcp://{PUBLISHER}:5555"
NEW_NETWORK, MAKE_DEVICE, PACKETS_ALONE = 0x40000000, 0x400454CA, 0x1001  # CLONE_NEWNET, TUNSETIFF, TUN without a head


def publish(keys: Keys) -> None:
    publisher = LivePublisher(ADDRESS, keys=keys)
    while not publisher.ready(1):
        time.sleep(0.02)
    began, image = time.monotonic(), np.zeros((480, 640, 3), np.uint8)
    for number in range(COUNT):
        publisher.send(Frame(number, number * INTERVAL, image, np.array([500.0, 500.0, 320.0, 240.0])))
        time.sleep(max(0.0, began + (number + 1) * INTERVAL - time.monotonic()))
    publisher.close()


def read(keys: Keys) -> None:
    reader, count = LiveReader(ADDRESS, Frame, keys=keys), 0
    while (message := reader.receive(10.0)) is not None and not isinstance(message, End):
        count += 1
    print(count, flush=True)


def host(address: str, end: socket.socket, act: Callable[[Keys], None], keys: Keys) -> int:
    """A process of its own, which sends its device's descriptor through `end` and begins when it is answered."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        if ctypes.CDLL(None, use_errno=True).unshare(NEW_NETWORK):
            raise PermissionError
        device = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(device, MAKE_DEVICE, struct.pack("16sH", b"tun0", PACKETS_ALONE))
        for words in (f"address add {address}/24 dev tun0", "link set tun0 mtu 60000 txqueuelen 5000 up"):
            subprocess.run(["ip", *words.split()], check=True, timeout=20)
        socket.send_fds(end, [b"here"], [device])
        end.recv(1)
        act(keys)
        code = 0
    except (OSError, subprocess.SubprocessError) as error:
        print(f"{address}: {error}", file=sys.stderr)
        code = NOT_PERMITTED
    finally:
        os._exit(code)


def carry(source: int, target: int) -> None:
    under_way: SimpleQueue[tuple[float, bytes]] = SimpleQueue()

    def arrive() -> None:
        while True:
            at, packet = under_way.get()
            time.sleep(max(0.0, at - time.monotonic()))
            os.write(target, packet)

    threading.Thread(target=arrive, daemon=True).start()
    while True:
        packet = os.read(source, 2**16)
        under_way.put((time.monotonic() + DELAY, packet))


def main(folder: Path) -> int:
    keys = create_keys(folder)
    pairs = [socket.socketpair() for _ in range(2)]
    processes = [
        host(PUBLISHER, pairs[0][1], publish, keys),
        host(READER, pairs[1][1], read, keys),
    ]
    devices: list[int] = []
    for ours, theirs in pairs:
        theirs.close()
        devices += socket.recv_fds(ours, 4, 1)[1]
    if len(devices) == 2:
        for source, target in (devices, devices[::-1]):
            threading.Thread(target=carry, args=(source, target), daemon=True).start()
        for ours, _ in pairs:
            ours.send(b"!")
    return max(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in processes)


if __name__ == "__main__":
    CODE = main(Path(sys.argv[1]))
    sys.stdout.flush()
    os._exit(CODE)  # the threads wait for packets
