"""Worker processes that end with their parent, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def worker_pool(workers: int, cores: Sequence[int] | None = None) -> ProcessPoolExecutor:
    """Return a pool of new processes that end silently on Ctrl-C, and with their parent if it is killed.

    Each may use one of ``cores``; None: any.
    """
    processes = multiprocessing.get_context("spawn")
    free: Any = None
    if cores is not None:
        free = processes.SimpleQueue()
        for core in cores:
            free.put(core)
    return ProcessPoolExecutor(workers, processes, initializer=_start, initargs=(free,))


def one_core_each(
    call: Callable[[Task], Result], tasks: Sequence[Task], cores: int | None = None
) -> Iterator[tuple[Task, Result]]:
    """Call an importable function with each task in a process that has one core; yield results as they finish.

    Trainings that run side by side neither wait for each other nor change each other's results. At most ``cores`` cores
    are used; None: all that this process may use.
    """
    known = sorted(os.sched_getaffinity(0))[:cores]
    with worker_pool(len(known), known) as pool:
        waiting = {pool.submit(call, task): task for task in tasks}
        try:
            for done in as_completed(waiting):
                yield waiting[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def await_interrupt() -> None:
    """Wait briefly after a worker died, so that a Ctrl-C that also killed it is raised here (KeyboardInterrupt)."""
    time.sleep(0.3)


def _start(free: Any) -> None:
    if free is not None:
        # Before JAX starts, which makes as many threads as there are cores.
        os.sched_setaffinity(0, {free.get()})
    # On Ctrl-C workers die at once and silently; the parent cleans up.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_die_with_parent, daemon=True).start()


def _die_with_parent() -> None:
    # A parent that is killed cannot stop its workers, and they would wait for work for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
