"""Sinks of logged metrics: ``metrics.jsonl``, and TensorBoard if tensorboardX is installed."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import math
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from drivax.errors import DataError
from drivax.files import atomic_write, inside, remove, sync_and_close
from drivax.reading import DAMAGE, read_lines

#: Least time between two flushes (s).
_FLUSH_S = 10.0
#: Largest log, in bytes: those of the presets have up to 61 MB.
_MOST_LOG = 512 << 20


class JsonLines:
    """A file with one JSON object per row: ``{"step": 100, "loss": 0.5, ...}``; NaN and infinities become null.

    Rows after ``resume_step`` are deleted, and new ones appended; None starts a new file.

    Raises:
        DataError: A row of the existing file is damaged, other than an incomplete last row.
    """

    def __init__(self, file: str | Path, resume_step: int | None = None) -> None:
        self.path = Path(file)
        if resume_step is not None and self.path.exists():
            with atomic_write(self.path, follow=False) as out:
                for row in read_rows(self.path):
                    if row["step"] <= resume_step:
                        out.write(f"{json.dumps(row)}\n".encode())
        else:
            remove(self.path)  # it may be a link or a pipe
        self._file = self.path.open("wb" if resume_step is None else "ab")

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Append a row and flush it, so that a crash does not lose it."""
        row: dict[str, Any] = {"step": int(step)}
        for name, value in values.items():
            row[name] = float(value) if math.isfinite(value) else None
        self._file.write(f"{json.dumps(row)}\n".encode())
        self._file.flush()

    def sync(self) -> None:
        """Flush to disk, so that a crash of the machine does not lose the rows of a checkpoint."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Flush the file to disk and close it."""
        if not self._file.closed:
            sync_and_close(self._file)


class TensorBoard:
    """TensorBoard events in the format of tensorboardX (extra ``track``), without those after ``resume_step``.

    ``SummaryWriter`` is not used: it writes in a thread that prints disk errors instead of raising them.
    """

    def __init__(self, folder: Path, resume_step: int | None = None) -> None:
        from tensorboardX.event_file_writer import EventsWriter

        event_pb2: Any = importlib.import_module("tensorboardX.proto.event_pb2")
        folder.mkdir(parents=True, exist_ok=True)
        self._event = event_pb2.Event
        self._file = EventsWriter(str(folder / "events"))
        self._next_flush = 0.0
        # TensorBoard drops the events of earlier processes from this step on.
        first_step = 0 if resume_step is None else resume_step + 1
        start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        self._file.write_event(self._event(wall_time=time.time(), step=first_step, session_log=start))

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Add a scalar for each value."""
        scalars = [{"tag": name, "simple_value": float(value)} for name, value in values.items()]
        self._file.write_event(self._event(wall_time=time.time(), step=int(step), summary={"value": scalars}))
        if time.monotonic() > self._next_flush:
            self._file.flush()
            self._next_flush = time.monotonic() + _FLUSH_S

    def close(self) -> None:
        """Flush the file and close it."""
        self._file.close()


class MetricLog:
    """Log of a run: ``metrics.jsonl`` in its folder, and TensorBoard events (default: if tensorboardX is installed).

    Rows after ``resume_step`` are deleted; None starts a new log.
    """

    def __init__(
        self, folder: str | Path, resume_step: int | None = None, tensorboard: bool | None = None
    ) -> None:
        folder = Path(folder)
        events = inside(folder, "tensorboard")
        self._rows = JsonLines(folder / "metrics.jsonl", resume_step)
        self.sinks: list[JsonLines | TensorBoard] = [self._rows]
        if tensorboard is None:
            tensorboard = importlib.util.find_spec("tensorboardX") is not None
        if tensorboard:
            self.sinks.append(TensorBoard(events, resume_step))

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Log the metrics of one step."""
        for sink in self.sinks:
            sink.write(step, values)

    def sync(self) -> None:
        """Flush ``metrics.jsonl`` to disk."""
        self._rows.sync()

    def close(self) -> None:
        """Flush and close all sinks."""
        with contextlib.ExitStack() as stack:
            for sink in self.sinks:
                stack.callback(sink.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_rows(file: str | Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of a ``metrics.jsonl`` file, without an incomplete last row; one at a time is in memory.

    Raises:
        DataError: A row is damaged, or the file has more than 512 MiB.
    """
    file = Path(file)
    for number, line in enumerate(read_lines(file, "train again", _MOST_LOG), start=1):
        try:
            row = json.loads(line)
            if not isinstance(row["step"], int):
                raise ValueError("a step that is not an integer")
        except DAMAGE as error:
            if not line.endswith("\n"):  # the incomplete last row
                return
            cure = "delete the row"
            raise DataError("not a metrics row", file=file, record=number, cure=cure) from error
        yield row
