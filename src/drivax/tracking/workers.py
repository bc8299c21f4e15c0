"""Worker processes that exit whenever their parent does."""

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
    """Return a pool of spawned processes that exit silently on Ctrl-C, and when their parent is killed.

    Each is bound to one of ``cores``; None: to no core.
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
    """Call an importable function with each task in a single-core process; yield results as they finish.

    Parallel tasks neither wait for each other nor change each other's results. At most ``cores`` cores are used; None:
    all cores of this process.
    """
    available = sorted(os.sched_getaffinity(0))[:cores]
    with worker_pool(len(available), available) as pool:
        futures = {pool.submit(call, task): task for task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
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
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    # A killed parent cannot stop its workers, which would wait for work forever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
