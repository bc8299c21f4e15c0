"""Where logged numbers go: ``metrics.jsonl`` always, TensorBoard where tensorboardX is installed."""

from __future__ import annotations

import importlib.util
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

from drivax.errors import DataError


@runtime_checkable
class Sink(Protocol):
    """Something that takes rows of numbers."""

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Take the numbers of one step."""
        ...

    def close(self) -> None:
        """Bring everything to the disk."""
        ...


class JsonLines:
    """One JSON object per row: ``{"step": 100, "loss": 0.5, ...}``; NaN and infinities become null.

    Args:
        file: The file; rows are appended.
        resume_step: Drop rows after this step (they belong to a run that was cut off); None starts afresh.

    Raises:
        DataError: A row of the existing file is damaged (a last row that was cut off is dropped silently).
    """

    def __init__(self, file: str | Path, resume_step: int | None = None) -> None:
        self.path = Path(file)
        if resume_step is not None and self.path.exists():
            _keep_until(self.path, resume_step)
        mode = "w" if resume_step is None else "a"
        self._file = self.path.open(mode, encoding="utf-8")

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Append a row and flush it, so that it survives the process."""
        row: dict[str, Any] = {"step": int(step)}
        for name, value in values.items():
            number = float(value)
            row[name] = number if math.isfinite(number) else None
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Bring everything to the disk."""
        if not self._file.closed:
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()


class TensorBoard:
    """TensorBoard events through tensorboardX (extra ``track``)."""

    def __init__(self, folder: str | Path, resume_step: int | None = None) -> None:
        from tensorboardX import SummaryWriter

        purge = None if resume_step is None else resume_step + 1
        self._writer = SummaryWriter(str(folder), purge_step=purge, write_to_disk=True)

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Add one scalar per number."""
        for name, value in values.items():
            self._writer.add_scalar(name, float(value), int(step))

    def close(self) -> None:
        """Bring everything to the disk."""
        self._writer.close()


class MetricLog:
    """The one thing that training code logs to.

    Args:
        folder: The run folder.
        resume_step: Continue a run from this step: later rows are dropped. None starts afresh.
        tensorboard: Write events too; None: where tensorboardX is installed.
    """

    def __init__(
        self, folder: str | Path, resume_step: int | None = None, tensorboard: bool | None = None
    ) -> None:
        folder = Path(folder)
        self.sinks: list[Sink] = [JsonLines(folder / "metrics.jsonl", resume_step)]
        if tensorboard is None:
            tensorboard = importlib.util.find_spec("tensorboardX") is not None
        if tensorboard:
            self.sinks.append(TensorBoard(folder / "tensorboard", resume_step))

    def write(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        """Log the numbers of one step; ``prefix`` and a slash go before every name."""
        named = {f"{prefix}/{name}" if prefix else name: value for name, value in values.items()}
        for sink in self.sinks:
            sink.write(step, named)

    def close(self) -> None:
        """Bring everything to the disk."""
        for sink in self.sinks:
            sink.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_rows(file: str | Path) -> Iterator[dict[str, Any]]:
    """The rows of a ``metrics.jsonl``; a last row that was cut off is left out.

    Raises:
        DataError: Another row is damaged.
    """
    for _, row in _rows(Path(file)):
        yield row


def _rows(file: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    for number, line in enumerate(lines):
        try:
            row = json.loads(line)
            row["step"]
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines) - 1 and not line.endswith("\n"):
                return
            raise DataError(
                "not a metrics row", file=file, record=number + 1, cure="delete the row"
            ) from error
        yield line if line.endswith("\n") else line + "\n", row


def _keep_until(file: Path, step: int) -> None:
    kept = [line for line, row in _rows(file) if row["step"] <= step]
    partial = file.with_name(f".{file.name}.partial-{os.getpid()}")
    with partial.open("w", encoding="utf-8") as out:
        out.writelines(kept)
        out.flush()
        os.fsync(out.fileno())
    partial.replace(file)
