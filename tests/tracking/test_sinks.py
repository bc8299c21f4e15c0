"""Logged numbers survive a crash, and a resumed run continues its log."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drivax.errors import DataError
from drivax.tracking.sinks import MetricLog, read_rows


def test_rows_are_on_disk_at_once(tmp_path: Path):
    log = MetricLog(tmp_path, tensorboard=False)
    log.write(0, {"loss": np.float32(0.5), "count": 3})
    log.write(10, {"score": float("nan"), "big": float("inf")})
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [
        {"step": 0, "loss": 0.5, "count": 3.0},
        {"step": 10, "score": None, "big": None},
    ]
    log.close()
    assert list(read_rows(tmp_path / "metrics.jsonl")) == rows


def test_resume_drops_later_rows(tmp_path: Path):
    with MetricLog(tmp_path, tensorboard=False) as log:
        for step in (0, 10, 20, 30):
            log.write(step, {"x": step})
    with MetricLog(tmp_path, resume_step=10, tensorboard=False) as log:
        log.write(20, {"x": -1})
    rows = [(row["step"], row["x"]) for row in read_rows(tmp_path / "metrics.jsonl")]
    assert rows == [(0, 0), (10, 10), (20, -1)]
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]


@pytest.mark.parametrize("resume_step", [None, 0])
def test_symbolic_links_of_a_stranger_are_not_written_through(tmp_path: Path, resume_step: int | None):
    victim, row = tmp_path / "victim", '{"step": 0}\n'
    victim.write_text(row)
    for name, target in (("run", victim), ("empty", tmp_path / "missing")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").symlink_to(target)
        with MetricLog(tmp_path / name, resume_step, tensorboard=False) as log:
            log.write(1, {"x": 2})
        assert [row["step"] for row in read_rows(tmp_path / name / "metrics.jsonl")][-1] == 1
    assert victim.read_text() == row and not (tmp_path / "missing").exists()
    (tmp_path / "run" / "tensorboard").symlink_to(tmp_path / "empty")
    with pytest.raises(DataError, match=r"tensorboard: is a symbolic link; replace"):
        MetricLog(tmp_path / "run")


def test_resume_drops_a_row_that_was_cut_off(tmp_path: Path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 0, "x": 1}\n{"step": 5, "x"')
    assert [row["step"] for row in read_rows(file)] == [0]
    with MetricLog(tmp_path, resume_step=5, tensorboard=False) as log:
        log.write(6, {"x": 2})
    assert file.read_text() == '{"step": 0, "x": 1}\n{"step": 6, "x": 2.0}\n'


def test_a_whole_last_row_without_newline_is_kept(tmp_path: Path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step": 0}\n{"step": 5}')
    with MetricLog(tmp_path, resume_step=5, tensorboard=False) as log:
        log.write(6, {})
    assert [row["step"] for row in read_rows(file)] == [0, 5, 6]


def test_a_damaged_row_is_named(tmp_path: Path):
    file = tmp_path / "metrics.jsonl"
    for damaged in ("nonsense", "[]", "{}", '{"x": 1}'):
        file.write_text(f'{{"step": 0}}\n{damaged}\n{{"step": 2}}\n')
        with pytest.raises(DataError, match=r"metrics\.jsonl: record 2: not a metrics row; delete the row"):
            MetricLog(tmp_path, resume_step=5, tensorboard=False)


def test_a_fresh_log_replaces_an_old_one(tmp_path: Path):
    for value in (1, 2):
        with MetricLog(tmp_path, tensorboard=False) as log:
            log.write(0, {"x": value})
    assert [row["x"] for row in read_rows(tmp_path / "metrics.jsonl")] == [2]


@pytest.mark.parametrize(("resume_step", "first"), [(None, 0), (5, 6)])
def test_tensorboard_events_start_after_the_resumed_step(tmp_path: Path, resume_step, first):
    """Earlier events are dropped from ``first`` on, also where no step is resumed."""
    pytest.importorskip("tensorboardX")
    from tensorboardX.proto.event_pb2 import Event, SessionLog

    with MetricLog(tmp_path, resume_step) as log:
        log.write(7, {"train/loss": 0.25})
    (file,) = (tmp_path / "tensorboard").iterdir()
    data, result, starts = file.read_bytes(), [], []
    while data:  # a TFRecord: length, its CRC, the payload, its CRC
        size = int.from_bytes(data[:8], "little")
        event = Event.FromString(data[12 : 12 + size])
        if event.session_log.status == SessionLog.START:
            starts.append(event.step)
        result += [(event.step, value.tag, value.simple_value) for value in event.summary.value]
        data = data[16 + size :]
    assert result == [(7, "train/loss", 0.25)] and starts == [first]


FAILING_CLOSE = """
import resource, sys
from pathlib import Path
from drivax.tracking.sinks import TensorBoard

log = TensorBoard(Path(sys.argv[1]))
for step in range(30):
    log.write(step, {"loss": 0.5})
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
try:
    log.close()
except OSError as error:
    print(error.strerror)
"""


def test_failing_tensorboard_raises_and_prints_nothing(tmp_path: Path):
    """No file may grow, as on a full disk."""
    pytest.importorskip("tensorboardX")
    command = [sys.executable, "-c", FAILING_CLOSE, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (result.stdout, result.stderr) == ("File too large\n", "")
