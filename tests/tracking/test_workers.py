"""Worker processes run tasks and exit with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from drivax.tracking.workers import one_core_each, worker_pool

PROGRAM = """
import sys, time
from drivax.tracking.workers import worker_pool

if __name__ == "__main__":
    pool = worker_pool(2)
    for future in [pool.submit(time.sleep, 0.1) for _ in range(4)]:
        future.result()
    print("ready", flush=True)
    {end}
"""


def group_is_gone(leader, seconds):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.killpg(leader, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


def test_pool_runs_tasks():
    with worker_pool(1) as pool:
        assert list(pool.map(abs, [-1, 2])) == [1, 2]


@pytest.mark.parametrize("end", ["time.sleep(60)", "pool.submit(time.sleep, 60); time.sleep(60)"])
def test_workers_end_with_a_killed_parent(tmp_path, end):
    (tmp_path / "program.py").write_text(PROGRAM.format(end=end))
    command = [sys.executable, str(tmp_path / "program.py")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    assert not group_is_gone(process.pid, 0.1)
    process.kill()
    process.wait()
    process.stdout.close()
    assert group_is_gone(process.pid, 10.0)


def on_which_cores(number):
    """Task of the workers."""
    return number, len(os.sched_getaffinity(0))


def test_closed_terminal_ends_a_pool_silently(tmp_path):
    """SIGHUP reaches the whole process group, Python's tracker of semaphores included."""
    end = "import signal; signal.signal(signal.SIGHUP, lambda *_: sys.exit(129)); print(1, flush=True); time.sleep(60)"
    (tmp_path / "program.py").write_text(PROGRAM.format(end=end))
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py")], text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None and [process.stdout.readline() for _ in range(2)] == [
        "ready\n",
        "set\n",
    ]
    os.killpg(process.pid, signal.SIGHUP)
    assert process.communicate(timeout=60)[1] == "" and process.returncode == 129
    assert group_is_gone(process.pid, 10.0)


def test_each_task_has_one_core():
    assert sorted(one_core_each(on_which_cores, [3, 1, 2], cores=2)) == [(n, (n, 1)) for n in (1, 2, 3)]
