"""A publisher and a reader with a long, fast link between them: `python -m tests.support.long_link FOLDER`.

Two network namespaces, each with a device whose packets this program carries to the other one, `DELAY` later. Prints
how many of the frames came; exit code 77 where namespaces are not permitted. FOLDER takes the keys.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
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
GO, NO = b"!", b"."
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


def device(address: str) -> int:
    """The descriptor of the one device of a network namespace of this process's own. Raises OSError and
    SubprocessError where that is not permitted."""
    if ctypes.CDLL(None, use_errno=True).unshare(NEW_NETWORK):
        raise OSError(ctypes.get_errno(), "unshare")
    made = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(made, MAKE_DEVICE, struct.pack("16sH", b"tun0", PACKETS_ALONE))
    for words in (f"address add {address}/24 dev tun0", "link set tun0 mtu 60000 txqueuelen 5000 up"):
        subprocess.run(["ip", *words.split()], check=True, timeout=20)
    return made


def host(address: str, end: socket.socket, act: Callable[[Keys], None], keys: Keys) -> int:
    """A process of its own, which sends its device's descriptor through `end` and begins when it is told to."""
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        try:
            own = [device(address)]
        except (OSError, subprocess.SubprocessError) as error:
            print(f"{address}: {error}", file=sys.stderr)
            own = []
        socket.send_fds(end, [b"here"], own)
        if end.recv(1) == GO:
            act(keys)
        code = 0 if own else NOT_PERMITTED
    except Exception:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
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
    devices = [device for ours, _ in pairs for device in socket.recv_fds(ours, 4, 1)[1]]
    both = len(devices) == 2
    if both:
        for source, target in (devices, devices[::-1]):
            threading.Thread(target=carry, args=(source, target), daemon=True).start()
    for ours, _ in pairs:
        ours.send(GO if both else NO)
    return verdict(exit_codes(processes))


def exit_codes(processes: list[int]) -> list[int]:
    """Of all of them; where one failed, the others, which would wait for it, are ended."""
    codes, left = [], set(processes)
    while left:
        process, status = os.wait()
        left.discard(process)
        codes.append(os.waitstatus_to_exitcode(status))
        if codes[-1] not in (0, NOT_PERMITTED):
            for other in left:
                os.kill(other, signal.SIGKILL)
    return codes


def verdict(codes: list[int]) -> int:
    """Of the hosts' exit codes, below 0 for signals: not permitted only where nothing else went wrong."""
    failed = {code for code in codes if code}
    return 0 if not failed else NOT_PERMITTED if failed == {NOT_PERMITTED} else 1


def run() -> None:
    code = main(Path(sys.argv[1]))
    sys.stdout.flush()
    os._exit(code)  # the threads wait for packets


if __name__ == "__main__":
    run()
