"""Worker processes run tasks and exit with their parent."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import threading
import time

import pytest

from drivax.datasets import conversion
from drivax.errors import DataError, UsageError
from drivax.scenario.schema import CAPACITIES
from drivax.synthetic import generate
from drivax.tracking import workers
from drivax.tracking.workers import available_cores, one_core_each, worker_pool

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


@pytest.mark.parametrize("tasks", [1, 50])
def test_dead_worker_is_one_line(tasks):
    """Also where a later task is submitted to the broken pool."""
    with (
        pytest.raises(
            DataError, match=r"a worker process died .*; use fewer --workers or --cores, or add the guard$"
        ),
        worker_pool(1) as pool,
    ):
        futures = [pool.submit(os._exit, 1)]
        for _ in range(1, tasks):
            time.sleep(0.1)
            futures.append(pool.submit(abs, 1))
        futures[0].result()


def ignore_sigterm():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def test_worker_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(workers, "_STOP_S", 0.2)
    with pytest.raises(KeyError), worker_pool(1) as pool:
        pool.submit(ignore_sigterm).result()
        pool.submit(time.sleep, 60)
        raise KeyError


def test_workers_ignore_what_their_parent_ignores():
    """A shell's background job ignores Ctrl-C."""
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with worker_pool(1) as pool:
            worker = pool.submit(os.getpid).result()
            os.kill(worker, signal.SIGINT)
            assert pool.submit(os.getpid).result() == worker
    finally:
        signal.signal(signal.SIGINT, previous)


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
    assert process.stdout is not None
    assert [process.stdout.readline() for _ in range(2)] == ["ready\n", "1\n"]
    os.killpg(process.pid, signal.SIGHUP)
    assert process.communicate(timeout=60)[1] == "" and process.returncode == 129
    assert group_is_gone(process.pid, 10.0)


def test_cores_are_counted_without_affinities(monkeypatch):
    """As on macOS."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert available_cores() == [0, 1, 2]


def test_each_task_has_one_core():
    assert sorted(one_core_each(on_which_cores, [3, 1, 2], cores=2)) == [(n, (n, 1)) for n in (1, 2, 3)]


@pytest.mark.parametrize("cores", [0, -1])
def test_no_cores_are_refused(cores):
    with pytest.raises(UsageError, match=f"the number of cores is {cores}; use 1 or more"):
        next(one_core_each(on_which_cores, [1], cores))


def send_half():
    """Task that begins to send its result and never ends, as a worker that is killed while it sends does."""
    frame = sys._getframe()
    while "result_queue" not in frame.f_locals:
        frame = frame.f_back
    os.write(frame.f_locals["result_queue"]._writer.fileno(), struct.pack("!i", 1000))
    time.sleep(60)


def sleep_in_conversion(number):
    """Conversion of a file: the first is empty, the next is slow."""
    time.sleep(60 * number)
    yield from ()


@pytest.fixture
def pools(monkeypatch):
    """Pools of the module that draws scenarios and of the one that converts files."""
    made = []

    def record_pool(*arguments):
        made.append(worker_pool(*arguments))
        return made[-1]

    for module in (generate, conversion):
        monkeypatch.setattr(module, "worker_pool", record_pool)
    return made


def join_threads(others):
    """Wait for all threads but these; that of a pool learns the exit codes of its workers."""
    for thread in set(threading.enumerate()) - others:
        thread.join(20)
        assert not thread.is_alive()


@pytest.mark.parametrize(("task", "arguments"), [(time.sleep, [60]), (send_half, [])])
def test_workers_end_when_the_block_is_left(task, arguments):
    threads = set(threading.enumerate())
    begin = time.monotonic()
    with pytest.raises(KeyError), worker_pool(1) as pool:
        pool.submit(on_which_cores, 1).result()  # imports this module
        pool.submit(task, *arguments)
        workers = list(pool._processes.values())
        time.sleep(0.5)
        raise KeyError
    join_threads(threads)
    assert not any(worker.is_alive() for worker in workers)
    assert time.monotonic() - begin < 40


def open_draws(tmp_path):
    return generate._draws(100_000, 1, generate.Generation(workers=1))


def open_conversion(tmp_path):
    return conversion.convert_ahead([(0,), (1,)], sleep_in_conversion, CAPACITIES["default"], 2, tmp_path)


@pytest.mark.parametrize("start", [open_draws, open_conversion])
def test_reader_that_stops_ends_the_workers(start, pools, tmp_path):
    """A signal, or an error of the reader, closes the generator."""
    threads = set(threading.enumerate())
    results = start(tmp_path)
    next(results)
    workers = list(pools[0]._processes.values())
    results.close()
    join_threads(threads)
    assert workers and -signal.SIGTERM in [worker.exitcode for worker in workers]
    assert list(tmp_path.iterdir()) == []
