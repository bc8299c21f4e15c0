"""Trainings side by side, each by itself on one core: none waits for another, and none changes another's bits."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def one_core_each(
    call: Callable[[Task], Result], tasks: Sequence[Task], cores: int | None = None
) -> Iterator[tuple[Task, Result]]:
    """Calls a function of every task in a process that has one core, and yields each result when it is there.

    Args:
        call: A function of a module, which a new process can import.
        tasks: What it is called with.
        cores: How many cores to use at most; None: all that this process may use.
    """
    processes, known = multiprocessing.get_context("spawn"), sorted(os.sched_getaffinity(0))[:cores]
    free = processes.SimpleQueue()
    for core in known:
        free.put(core)
    with ProcessPoolExecutor(len(known), processes, initializer=_on_one_core, initargs=(free,)) as pool:
        waiting = {pool.submit(call, task): task for task in tasks}
        try:
            for done in as_completed(waiting):
                yield waiting[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _on_one_core(free: Any) -> None:
    # Before JAX starts, which makes as many threads as there are cores.
    os.sched_setaffinity(0, {free.get()})
