"""What is written of one agent's run: rows of numbers, checkpoints, and the validations that they are compared by."""

from __future__ import annotations

import signal
import threading
from collections.abc import Mapping, Sequence
from types import FrameType, TracebackType
from typing import Any, Self

from drivax.errors import DrivaxError
from drivax.learning.config import TrainConfig
from drivax.learning.validation import rank
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import MetricLog, read_rows


class Preempted(DrivaxError):
    """The run was told to stop (SIGTERM), has written a checkpoint, and can be resumed."""

    status = 128 + signal.SIGTERM


class StopSignal:
    """Notices SIGTERM instead of dying of it, while it is entered; a second one kills as usual.

    Batch systems send it some seconds before they take a machine away. Outside of the main thread, where Python has no
    signals, nothing is noticed.
    """

    def __init__(self) -> None:
        self.asked = False
        self._former: Any = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._former = signal.signal(signal.SIGTERM, self._notice)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._former is not None:
            signal.signal(signal.SIGTERM, self._former)

    def _notice(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def patience_is_up(ranks: Sequence[tuple[float, ...]], patience: int) -> bool:
    """Whether the last ``patience`` validations were no better than the best before them; never, if it is 0."""
    if not patience or len(ranks) <= patience:
        return False
    return max(ranks[-patience:]) <= max(ranks[:-patience])


class Journal:
    """The run folder of one agent while it learns.

    Args:
        folder: The folder.
        config: What is trained.
    """

    def __init__(self, folder: RunFolder, config: TrainConfig) -> None:
        self.folder = folder
        self.config = config
        self.checkpoints = Checkpoints(folder.checkpoints, config.keep)
        self._ranks: list[tuple[float, ...]] = []
        self._log: MetricLog | None = None
        newest = self.newest
        if newest is not None and folder.metrics.is_file():
            self._remember(newest)

    @property
    def newest(self) -> int | None:
        """Step of the newest checkpoint."""
        return max(self.checkpoints.steps(), default=None)

    @property
    def over(self) -> bool:
        """Whether the agent's patience is up: nothing more is written of it."""
        return patience_is_up(self._ranks, self.config.patience)

    def begin(self, step: int | None) -> None:
        """Opens the log: afresh, or after a step of the run so far, of which what is later is dropped."""
        if step is not None:
            self.checkpoints.drop_after(step)
            self._remember(step)
        self._log = MetricLog(self.folder.path, resume_step=step)

    def _remember(self, step: int) -> None:
        """The validations up to a step."""
        rows = [row for row in read_rows(self.folder.metrics) if row["step"] <= step]
        ranks = [rank(self.config.checkpoint_rule, row) for row in rows]
        self._ranks = [found for found in ranks if found is not None]

    def write(self, step: int, row: Mapping[str, float]) -> tuple[float, ...] | None:
        """Logs the numbers of one iteration; returns what a checkpoint of it is compared by."""
        if self._log is None:
            raise RuntimeError("begin first")
        self._log.write(step, row)
        found = rank(self.config.checkpoint_rule, row)
        if found is not None:
            self._ranks.append(found)
        return found

    def save(self, step: int, state: Any, found: tuple[float, ...] | None) -> None:
        """Stores a checkpoint."""
        self.checkpoints.save(step, state, found)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._log is not None:
            self._log.close()
