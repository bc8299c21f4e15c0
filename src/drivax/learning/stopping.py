"""What ends a run before its last iteration: a signal to stop, and patience that is up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from types import FrameType, TracebackType
from typing import Any, Self

from drivax.errors import DrivaxError


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
