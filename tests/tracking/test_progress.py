"""Progress: lines in a log, a bar on a terminal, and rates."""

from __future__ import annotations

import io

import pytest

from drivax.tracking.progress import Progress, duration


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_lines_in_a_log():
    clock, stream = Clock(), io.StringIO()
    with Progress("converting", "scenarios", 1000, stream=stream, interval_s=10, clock=clock) as progress:
        for second in range(1, 26):
            clock.now = float(second)
            progress.advance(20, note="3 skipped")
    assert stream.getvalue().splitlines() == [
        "converting: 200 of 1,000 scenarios (20 %), 20/s, 40.0 s left, 3 skipped",
        "converting: 400 of 1,000 scenarios (40 %), 20/s, 30.0 s left, 3 skipped",
        "converting: 500 scenarios in 25.0 s, 20/s",
    ]


def test_unknown_total_and_failure():
    clock, stream = Clock(), io.StringIO()
    with pytest.raises(RuntimeError), Progress("x", "files", stream=stream, interval_s=1, clock=clock) as p:
        clock.now = 2.0
        p.update(3)
        raise RuntimeError
    assert stream.getvalue() == "x: 3 files, 1.5/s\n"  # no summary of what did not end


def test_total_may_become_known():
    clock, stream = Clock(), io.StringIO()
    progress = Progress("x", "files", stream=stream, clock=clock)
    clock.now = 10.0
    progress.update(5, total=10)
    assert stream.getvalue() == "x: 5 of 10 files (50 %), 0.5/s, 10.0 s left\n"


def test_work_of_earlier_runs_does_not_count_in_the_rate():
    clock, stream = Clock(), io.StringIO()
    with Progress("training", "steps", 1000, done=900, stream=stream, clock=clock) as progress:
        clock.now = 10.0
        progress.update(950)
    assert stream.getvalue().splitlines() == [
        "training: 950 of 1,000 steps (95 %), 5/s, 10.0 s left",
        "training: 950 steps in 10.0 s, 5/s",
    ]


def test_bar_on_a_terminal():
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress("training", "steps", 10, stream=stream) as progress:
        progress.update(10, note="loss 0.5")
    text = stream.getvalue()
    assert "10/10" in text
    assert "steps/s" in text
    assert "loss 0.5" in text
    assert text.splitlines()[-1].split(" in ")[0].endswith("training: 10 steps")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"), (59.94, "59.9 s"), (59.96, "1 min 0 s"), (185, "3 min 5 s"), (3599.6, "1 h 0 min"),
        (7800, "2 h 10 min"), (90000, "25 h 0 min"),
    ],
)  # fmt: skip
def test_durations_are_printed_in_suitable_units(seconds: float, text: str):
    assert duration(seconds) == text
