"""`python -m nodes SPEC.json`: runs one node; nodes/runtime/spec.py has the file's form.

What must precede the imports of torch and of the node is done here. A launcher should set the thread counts in the
environment as well: numpy, which comes with the package, reads its own only then. It should also start this process
with `nodes.runtime.signals.STARTING` blocked (`signal.pthread_sigmask`): what comes during the imports then waits.
"""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
from pathlib import Path

from nodes.runtime.signals import Signals
from nodes.runtime.spec import Spec

PR_SET_PDEATHSIG = 1


def main(arguments: list[str]) -> int:
    signals = Signals()
    signals.install()
    if len(arguments) != 1:
        print("usage: python -m nodes SPEC.json", file=sys.stderr)
        return 2
    logging.basicConfig(level=logging.INFO, format="%(asctime)s.%(msecs)03d %(message)s", datefmt="%H:%M:%S")
    try:
        spec = Spec.read(Path(arguments[0]))
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    signals.by_hand = spec.status_fd is None
    if not signals.by_hand:
        _die_with_parent()
    _place(spec)
    from nodes.runtime.process import run

    return run(spec, signals)


def _die_with_parent() -> None:
    """No node outlives a launcher that was killed. (The signal comes when the *thread* that started this one ends.)"""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _place(spec: Spec) -> None:
    """Cores and threads, before the libraries that read them are loaded."""
    niceness = min(19, os.getpriority(os.PRIO_PROCESS, 0) + spec.nice)  # a run may give way to others as a whole
    for task in Path("/proc/self/task").iterdir():  # numpy has started threads already
        if spec.cpu is not None:
            os.sched_setaffinity(int(task.name), spec.cpu)
        if spec.nice:
            os.setpriority(os.PRIO_PROCESS, int(task.name), niceness)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if spec.threads is not None:
        for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
            os.environ[name] = str(spec.threads)


if __name__ == "__main__":
    code = main(sys.argv[1:])
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # a source's thread may hang in its camera's driver, where the interpreter's end would wait or crash
