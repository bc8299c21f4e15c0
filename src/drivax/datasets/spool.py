"""Files converted ahead in worker processes: records wait on the disk, not in memory, until it is their turn.

Workers stream assembled records to a file each; what comes back through the process boundary is small.
"""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets.reader import BadRecord
from drivax.errors import DataError
from drivax.scenario.schema import Capacity, Scenario, SourceCounts, record_dtype
from drivax.tracking.workers import await_interrupt, worker_pool


@dataclass(frozen=True)
class _Kept:
    """A scenario whose record is in the spool file."""

    source: SourceCounts
    overflow: dict[str, int]
    tags: dict[str, str]


def converted_ahead(
    tasks: Sequence[tuple[Any, ...]],
    convert: Callable[..., Iterator[Scenario | BadRecord]],
    capacity: Capacity,
    workers: int,
    folder: Path,
) -> Generator[Iterator[Scenario | BadRecord], None, None]:
    """The results of tasks in the order of the tasks, made in worker processes.

    Args:
        tasks: Arguments that can be sent to other processes.
        convert: What a worker does with those of one task, a function of a module.
        capacity: Padded sizes of the scenarios.
        workers: Number of processes.
        folder: An existing folder for what waits: about ``workers + 2`` tasks' worth.

    Yields:
        The scenarios and bad records of one task; read them before asking for the next.
    """
    spool = folder / f"spool-{os.getpid()}"
    spool.mkdir()
    pool = worker_pool(min(workers, len(tasks)))
    waiting: deque[tuple[Path, Future[list[_Kept | BadRecord]]]] = deque()
    todo = iter(enumerate(tasks))
    try:
        while True:
            # Two tasks ahead keep all workers busy and bound the space on the disk.
            while len(waiting) < workers + 2 and (following := next(todo, None)) is not None:
                path = spool / f"{following[0]}.records"
                waiting.append((path, pool.submit(_spool, following[1], convert, capacity, path)))
            if not waiting:
                return
            path, future = waiting.popleft()
            yield _unspool(future, path, capacity)
            path.unlink(missing_ok=True)
    finally:
        shutil.rmtree(spool, ignore_errors=True)  # signals workers to stop
        pool.shutdown(wait=True, cancel_futures=True)


def _spool(
    task: tuple[Any, ...],
    convert: Callable[..., Iterator[Scenario | BadRecord]],
    capacity: Capacity,
    path: Path,
) -> list[_Kept | BadRecord]:
    """Runs in workers: one task, its records to ``path``."""
    items: list[_Kept | BadRecord] = []
    if not path.parent.is_dir():
        return items
    with path.open("wb") as file:
        for item in convert(*task):
            if not path.exists():
                break
            if isinstance(item, BadRecord):
                items.append(item)
                continue
            file.write(item.record.tobytes())
            items.append(_Kept(item.source, item.overflow, item.tags))
    return items


def _unspool(
    future: Future[list[_Kept | BadRecord]], path: Path, capacity: Capacity
) -> Iterator[Scenario | BadRecord]:
    try:
        items = future.result()
    except BrokenProcessPool as error:
        await_interrupt()
        raise DataError(
            "a worker process died (out of memory, or a script without a main guard)",
            cure="use fewer --workers; what is finished is kept, the same command continues",
        ) from error
    dtype = record_dtype(capacity)
    with path.open("rb") as file:
        for item in items:
            if isinstance(item, BadRecord):
                yield item
                continue
            record = np.frombuffer(file.read(dtype.itemsize), dtype).reshape(())
            yield Scenario(record, capacity, item.source, item.overflow, tags=item.tags)
