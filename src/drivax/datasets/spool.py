"""Convert files ahead in worker processes: assembled records wait on the disk, not in memory, for their turn."""

from __future__ import annotations

import os
import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax.datasets.reader import BadRecord
from drivax.scenario.schema import Capacity, Scenario, record_dtype
from drivax.tracking.workers import worker_pool

#: In place of a record that is in the spool file.
_SPOOLED = np.zeros(())


def convert_ahead(
    tasks: Sequence[tuple[Any, ...]],
    convert: Callable[..., Iterator[Scenario | BadRecord]],
    capacity: Capacity,
    workers: int,
    folder: Path,
) -> Generator[Iterator[Scenario | BadRecord], None, None]:
    """Yield the scenarios and bad records of each task in order; read them before asking for the next task's.

    Args:
        tasks: Arguments of ``convert``, which can be sent to other processes.
        convert: What a worker does, a function of a module.
        capacity: Padded sizes of the scenarios.
        workers: Number of processes.
        folder: An existing folder for the records of about ``workers + 2`` tasks.
    """
    spool = folder / f"spool-{os.getpid()}"
    spool.mkdir()
    waiting: deque[tuple[Path, Future[list[Scenario | BadRecord]]]] = deque()
    remaining = enumerate(tasks)
    try:
        with worker_pool(min(workers, len(tasks))) as pool:
            while True:
                # Two tasks ahead keep all workers busy and bound the space on the disk.
                while len(waiting) < workers + 2 and (item := next(remaining, None)) is not None:
                    number, task = item
                    path = spool / f"{number}.records"
                    waiting.append((path, pool.submit(_spool, task, convert, path)))
                if not waiting:
                    return
                path, future = waiting.popleft()
                yield _unspool(future.result(), path, capacity)
                path.unlink(missing_ok=True)
    finally:
        shutil.rmtree(spool, ignore_errors=True)


def _spool(
    task: tuple[Any, ...], convert: Callable[..., Iterator[Scenario | BadRecord]], path: Path
) -> list[Scenario | BadRecord]:
    """Run one task in a worker: write the records of its scenarios to ``path``, return all else."""
    items: list[Scenario | BadRecord] = []
    with path.open("wb") as file:
        for item in convert(*task):
            if isinstance(item, Scenario):
                file.write(item.record.tobytes())
                item = replace(item, record=_SPOOLED)
            items.append(item)
    return items


def _unspool(
    items: Sequence[Scenario | BadRecord], path: Path, capacity: Capacity
) -> Iterator[Scenario | BadRecord]:
    """Yield the results of a task, with their records from ``path``."""
    dtype = record_dtype(capacity)
    with path.open("rb") as file:
        for item in items:
            if isinstance(item, Scenario):
                record = np.frombuffer(file.read(dtype.itemsize), dtype).reshape(())
                item = replace(item, record=record)
            yield item
