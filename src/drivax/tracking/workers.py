"""Worker processes that exit with their parent."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from drivax.errors import DataError, UsageError

#: Errors when a semaphore cannot be created; on Linux, semaphores lie in /dev/shm.
_NO_SHARED_MEMORY = (errno.ENOENT, errno.ENOSYS, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC)
#: A Ctrl-C that killed a worker raises KeyboardInterrupt in its parent within this time (s).
_INTERRUPT_S = 0.3
#: A worker that has not ended in this time after SIGTERM is killed (s).
_STOP_S = 10.0

#: Python starts workers with ``-c``, and would import their first modules from the current folder.
_SAFE_PATH = {"PYTHONSAFEPATH": "1"}

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerPool(ProcessPoolExecutor):
    """A process pool that terminates its workers, and kills them after 10 s, if the ``with`` block raises.

    Raises:
        DataError: A worker died; raised at the end of the block.
    """

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        """Wait for the workers, or terminate them after an exception (a signal may reach this process alone)."""
        if kind is not None:
            self._stop()
        self.shutdown()
        if isinstance(error, BrokenProcessPool):
            time.sleep(_INTERRUPT_S)
            problem = "a worker process died (out of memory, or a script without a main guard)"
            raise DataError(problem, cure="use fewer --workers or --cores, or add the guard") from error

    def submit(self, *arguments: Any, **options: Any) -> Future[Any]:
        """Submit a call; a worker that is started for it receives Ctrl-C only after it has set up its signals."""
        with _block(signal.SIGINT), environment(**_SAFE_PATH):
            return super().submit(*arguments, **options)

    def _stop(self) -> None:
        processes = list((self._processes or {}).values())
        result_queue: Any = self._result_queue
        self.shutdown(wait=False, cancel_futures=True)
        result_queue._writer.close()  # else the pool's thread waits for the rest of a worker's unfinished result
        for process in processes:
            process.terminate()
        for process in processes:
            # A training run only notes SIGTERM, and may then wait for a lock that a dead worker holds.
            process.join(_STOP_S)
            process.kill()
            process.join()


def worker_pool(workers: int, cores: Sequence[int] | None = None) -> WorkerPool:
    """Return a pool of spawned processes that exit silently on Ctrl-C, and when their parent is killed.

    Each process is bound to one of ``cores``, if given.
    """
    context = multiprocessing.get_context("spawn")
    core_queue: Any = None
    try:
        # A closed terminal must not end Python's resource tracker, the process that removes semaphores.
        with _block(signal.SIGHUP), environment(**_SAFE_PATH):
            resource_tracker.ensure_running()
        if cores is not None:
            core_queue = context.SimpleQueue()
            for core in cores:
                core_queue.put(core)
        return WorkerPool(workers, context, initializer=_start, initargs=(core_queue,))
    except OSError as error:  # has no filename, so recognise it by its errno
        if error.errno not in _NO_SHARED_MEMORY:
            raise
        problem = f"no shared memory for worker processes ({os.strerror(error.errno)})"
        cure = "mount it (docker run --shm-size 1g), or make room there"
        raise UsageError(problem, file="/dev/shm", cure=cure) from error


def available_cores() -> list[int]:
    """Return the CPU cores that this process may use; all cores on systems without CPU affinity (macOS)."""
    has_affinity = hasattr(os, "sched_getaffinity")
    return sorted(os.sched_getaffinity(0)) if has_affinity else list(range(os.cpu_count() or 1))


def one_core_each(
    call: Callable[[Task], Result], tasks: Sequence[Task], cores: int | None = None
) -> Iterator[tuple[Task, Result]]:
    """Call an importable function with each task in a single-core process; yield (task, result) as calls finish.

    Parallel tasks neither wait for each other nor affect each other's results. At most ``cores`` cores are used, by
    default all cores of this process.

    Raises:
        UsageError: ``cores`` is below 1.
    """
    if cores is not None and cores < 1:
        raise UsageError(f"the number of cores is {cores}", cure="use 1 or more")
    available = available_cores()[:cores]
    with worker_pool(len(available), available) as pool:
        futures = {pool.submit(call, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextlib.contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Set environment variables in this process and in those that it starts, and restore them at the end."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _block(number: signal.Signals) -> Iterator[None]:
    """Block a signal in this thread and in the processes that it starts."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (number,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _start(core_queue: Any) -> None:
    """Set up a worker process: its core, if there is a queue of cores, its signals, and its exit with the parent."""
    if core_queue is not None and hasattr(os, "sched_setaffinity"):
        # JAX starts one thread per core, so restrict the cores first.
        os.sched_setaffinity(0, {core_queue.get()})
    # On Ctrl-C, workers exit at once and silently; the parent cleans up, unless it ignores the signal (cmd &).
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    # A killed parent cannot stop its workers, which would then wait forever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
