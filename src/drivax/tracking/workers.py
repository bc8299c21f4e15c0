"""Worker processes that end with their parent, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ProcessPoolExecutor


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """A pool of fresh processes: on Ctrl-C they die silently, and a parent that is killed takes them along.

    Args:
        workers: Number of processes.
    """
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=_start)


def await_interrupt() -> None:
    """For whoever finds a worker dead: Ctrl-C kills workers, too, and may reach them first.

    Raises:
        KeyboardInterrupt: That was it.
    """
    time.sleep(0.3)


def _start() -> None:
    # On Ctrl-C workers die at once and silently; the parent cleans up.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_die_with_parent, daemon=True).start()


def _die_with_parent() -> None:
    """A parent that is killed cannot stop its workers, and they would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
