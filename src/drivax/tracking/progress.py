"""Progress reports: a bar with rate and remaining time on a terminal, a line every few seconds in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Self

from drivax.escaping import escape_controls

#: Seconds between two lines in a log.
INTERVAL_S = 10.0


class Progress:
    """A context manager that reports progress, rate and remaining time, and prints a summary at the end.

    Args:
        work: Name of the work ("converting").
        unit: Counted unit ("scenarios").
        total: Final count; None if unknown.
        done: Count that earlier runs reached, which does not count towards the rate.
        stream: Text file to write to; standard error by default, so that standard output contains only results.
        interval_s: Seconds between two lines if ``stream`` is not a terminal.
        clock: Returns the time in seconds.
    """

    def __init__(
        self, work: str, unit: str, total: int | None = None, *, done: int = 0, stream: Any = None,
        interval_s: float = INTERVAL_S, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.work, self.unit, self.total = escape_controls(work), unit, total
        self.done = self._done_before = done
        self._stream = sys.stderr if stream is None else stream
        self._interval_s, self._clock = interval_s, clock
        self._start = self._last = clock()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Self:
        self._start = self._last = self._clock()
        if self._stream.isatty():
            self._start_bar()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if kind is None:
            self._print(self.summary())

    def update(self, done: int, note: str = "", total: int | None = None) -> None:
        """Report the count so far, followed by a note; ``total`` replaces the final count."""
        self.done = done
        self.total = self.total if total is None else total
        if self._bar is not None:
            rate = f"{_format_number(self.rate())} {self.unit}/s"
            self._bar.update(self._task, completed=done, total=self.total, rate=rate, note=note)
            return
        now = self._clock()
        if now - self._last >= self._interval_s:
            self._last = now
            self._print(self.line(note))

    def advance(self, count: int = 1, note: str = "") -> None:
        """Increase the count."""
        self.update(self.done + count, note)

    def rate(self) -> float:
        """Return the rate per second since the start."""
        return (self.done - self._done_before) / max(self._clock() - self._start, 1e-9)

    def line(self, note: str = "") -> str:
        """Return the progress as one line."""
        rate, count, remaining = self.rate(), f"{self.done:,} {self.unit}", ""
        if self.total:
            count = f"{self.done:,} of {self.total:,} {self.unit} ({100 * self.done / self.total:.0f} %)"
            remaining = f"{duration((self.total - self.done) / rate)} left" if rate > 0 else ""
        fields = (f"{self.work}: {count}", f"{_format_number(rate)}/s", remaining, note)
        return ", ".join(field for field in fields if field)

    def summary(self) -> str:
        """Return count, duration and rate as one line."""
        elapsed, rate = duration(self._clock() - self._start), _format_number(self.rate())
        return f"{self.work}: {self.done:,} {self.unit} in {elapsed}, {rate}/s"

    def _print(self, text: str) -> None:
        self._stream.write(text + "\n")
        self._stream.flush()

    def _start_bar(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        formats = ("{task.description}", "{task.fields[rate]}", "{task.fields[note]}")
        description, rate, note = map(partial(TextColumn, markup=False), formats)
        columns = (description, BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn(), note)
        self._bar = Bar(*columns, console=Console(file=self._stream), transient=True)
        self._task = self._bar.add_task(self.work, total=self.total, completed=self.done, rate="", note="")
        self._bar.start()


def duration(seconds: float) -> str:
    """Format seconds as ``4.2 s``, ``3 min 5 s`` or ``2 h 10 min``."""
    if seconds < 59.95:  # more would be rounded to 60.0 s
        return f"{seconds:.1f} s"
    whole_seconds = round(seconds)
    if whole_seconds < 3600:
        return f"{whole_seconds // 60} min {whole_seconds % 60} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60} min"


def _format_number(value: float) -> str:
    """Format a number with three significant digits, or all digits before the decimal point."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
