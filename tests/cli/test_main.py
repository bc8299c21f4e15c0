"""The command line: list of commands, error messages, exit status."""

from __future__ import annotations

import dataclasses
import importlib
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from multiprocessing import resource_tracker, synchronize
from pathlib import Path
from typing import Any

import pytest
from orbax.checkpoint._src import asyncio_utils

from drivax import cli
from drivax.errors import DataError, UsageError


@dataclasses.dataclass(frozen=True)
class Probe:
    """A command for tests. Example: drivax probe --number 3"""

    number: int = 1
    flag: bool = False


@pytest.fixture
def probe(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes ``drivax probe`` run a function."""

    def install(function: Any, overrides: bool = False) -> None:
        module = types.ModuleType("drivax.cli.probe")
        module.Probe, module.run = Probe, function  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "drivax.cli.probe", module)
        monkeypatch.setattr(cli, "COMMANDS", {**cli.COMMANDS, "probe": cli.Command("for tests", overrides)})

    return install


def raiser(error: BaseException) -> Any:
    def run(args: Probe) -> int:
        raise error

    return run


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"], ["help"]])
def test_overview_lists_all_commands_in_100_columns(argv: list[str], capsys: pytest.CaptureFixture[str]):
    assert cli.main(argv) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in cli.COMMANDS)
    assert max(map(len, out.splitlines())) <= 100


def test_version_equals_that_of_the_project_file(capsys: pytest.CaptureFixture[str], repository: Path):
    assert cli.main(["--version"]) == 0
    version = capsys.readouterr().out.removeprefix("drivax ").strip()
    assert f'version = "{version}"' in (repository / "pyproject.toml").read_text()


def test_flags_reach_the_command(probe: Any):
    seen = []
    probe(lambda args: seen.append(args) or 0)
    assert cli.main(["probe", "--number", "3", "--flag"]) == 0
    assert seen == [Probe(3, True)]


def test_exit_status_is_that_of_the_command(probe: Any):
    probe(lambda args: 5)
    assert cli.main(["probe"]) == 5


def test_overrides_reach_the_command(probe: Any):
    seen = []
    probe(lambda args, rest: seen.append((args, rest)) or 0, overrides=True)
    assert cli.main(["probe", "--number", "3", "--section.key", "1e-3"]) == 0
    assert seen == [(Probe(3), ["--section.key", "1e-3"])]


@pytest.mark.parametrize(
    ("error", "line", "status"),
    [
        (
            DataError("is damaged", file="a.npy", record=3, cure="copy it again"),
            "a.npy: record 3: is damaged; copy it again",
            1,
        ),
        (UsageError("is wrong"), "is wrong", 2),
        (KeyboardInterrupt(), "interrupted", 130),
        (
            PermissionError(13, "Permission denied", "/x"),
            "/x: permission denied; change the permissions of the file or of its folder, or choose another",
            1,
        ),
        (
            OSError(28, "No space left on device"),
            "no space left on device; make room, or choose another disk",
            1,
        ),
        (
            ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.pyplot"),
            "matplotlib is not installed; pip install 'drivax[show]'",
            1,
        ),
        (KeyError("a\nb"), r"unexpected KeyError: 'a\nb'; --debug shows where", 1),
    ],
)
def test_errors_are_one_line(
    probe: Any, capsys: pytest.CaptureFixture[str], error: BaseException, line: str, status: int
):
    probe(raiser(error))
    assert cli.main(["probe"]) == status
    captured = capsys.readouterr()
    assert captured.err == f"drivax: {line}\n"
    assert captured.out == ""


def test_debug_shows_the_traceback(probe: Any, capsys: pytest.CaptureFixture[str]):
    probe(raiser(DataError("is damaged")))
    assert cli.main(["probe", "--debug"]) == 1
    error = capsys.readouterr().err
    assert "Traceback" in error
    assert "in raiser" in error or "in run" in error
    assert error.endswith("drivax: is damaged\n")


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (["convrt"], "unknown command 'convrt'; did you mean 'convert'?"),
        (["zzz"], "unknown command 'zzz'; see drivax --help"),
        (["--vresion"], "unknown option '--vresion'; see drivax --help"),
    ],
)
def test_unknown_command_suggests_the_closest_one(
    argv: list[str], line: str, capsys: pytest.CaptureFixture[str]
):
    assert cli.main(argv) == 2
    assert capsys.readouterr().err == f"drivax: {line}\n"


@pytest.mark.parametrize("argv", [["probe", "--nmber", "3"], ["probe", "--number", "x"], ["probe", "extra"]])
def test_usage_errors_have_status_2(probe: Any, argv: list[str], capsys: pytest.CaptureFixture[str]):
    probe(lambda args: 0)
    assert cli.main(argv) == 2
    assert "drivax probe" in capsys.readouterr().err or argv[-1] == "x"


def test_command_help_lists_its_flags(probe: Any, capsys: pytest.CaptureFixture[str]):
    probe(lambda args: 0)
    assert cli.main(["probe", "--help"]) == 0
    assert "--number" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(cli.COMMANDS))
def test_each_command_help_has_an_example_within_100_columns(name: str, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert cli.main([name, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"drivax {name}" in out
    assert max(map(len, out.splitlines())) <= 100
    config = getattr(importlib.import_module(f"drivax.cli.{name}"), name.capitalize())
    assert dataclasses.is_dataclass(config)
    assert config.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert "Example" in (config.__doc__ or "")


def test_help_imports_nothing_heavy():
    program = (
        "import sys; from drivax.cli import main; main(['--help'])\n"
        "heavy = {'jax', 'numpy', 'tyro', 'rich', 'yaml', 'json', 'drivax.seal', 'drivax.files'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_export_imports_no_reader():
    program = (
        "import sys; import drivax.cli.export, drivax.datasets.export.writer\n"
        "print('drivax.datasets.formats' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False\n"


def test_console_prints_text_as_it_is(capsys):
    cli.console().print("scenario:car:1 [bold]")
    assert capsys.readouterr().out == "scenario:car:1 [bold]\n"


def test_closed_pipe_is_not_an_error():
    """``drivax --help | head -1``: no traceback, nothing on standard error."""
    pipeline = f"'{sys.executable}' -m drivax --help | head -c 1"
    result = subprocess.run(["bash", "-c", pipeline], capture_output=True, text=True, check=False)
    assert (result.stdout, result.stderr) == ("d", "")


@pytest.mark.parametrize(
    "command", ["evaluate --planner idm --data none --out run", "inspect none", "doctor", "convert none out"]
)
@pytest.mark.parametrize("limit", ["500000", "1300000"])
def test_low_memory_limit_is_one_line(limit, command):
    shell = f"ulimit -v {limit}; exec '{sys.executable}' -m drivax {command}"
    result = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=False)
    needed = "drivax: JAX needs 1433600 kB of memory, the limit of this process is"
    assert result.stderr == f"{needed} {limit}; raise the limit: ulimit -v unlimited\n"
    assert (result.returncode, result.stdout) == (2, "")


def run_limited(tmp_path, limit, *prefix):
    """Generate a set after a shell command that limits the process; return status, last line, and files left behind."""
    command = ["generate", str(tmp_path / "out"), "--scenarios", "2", "--workers", "2"]
    program = [*prefix, "sh", "-c", f'{limit}; exec "$@"', "sh", sys.executable, "-m", "drivax", *command]
    result = subprocess.run(program, capture_output=True, text=True, check=False)
    assert "Traceback" not in result.stderr
    return result.returncode, result.stderr.splitlines()[-1], [path.name for path in tmp_path.iterdir()]


def test_few_open_files_are_one_line(tmp_path):
    """Where it fails depends on the versions of Python and libraries."""
    status, line, left = run_limited(tmp_path, "ulimit -n 10")
    cause = (
        "too many open files (limit of open files: 10); raise the limit: ulimit -n 20, or use fewer --workers"
    )
    assert (status, left) == (1, []) and line.startswith(f"drivax: {tmp_path}/") and line.endswith(cause)


@pytest.mark.skipif(shutil.which("unshare") is None, reason="the system has no user namespaces")
@pytest.mark.parametrize(
    ("mount", "error"), [("-o ro", "Read-only file system"), ("-o size=4k", "No space left on device")]
)
def test_workers_without_shared_memory_are_one_line(mount, error, tmp_path):
    user = ("unshare", "--user", "--map-root-user", "--mount")
    shm = f"mount -t tmpfs {mount} tmpfs /dev/shm && (head -c 4096 /dev/zero > /dev/shm/full; true) 2> /dev/null"
    if subprocess.run([*user, "sh", "-c", shm], capture_output=True).returncode:
        pytest.skip("/dev/shm cannot be replaced in a user namespace")
    status, line, left = run_limited(tmp_path, shm, *user)
    problem = f"drivax: /dev/shm: no shared memory for worker processes ({error}); mount it (docker run --shm-size 1g)"
    assert (status, left) == (2, []) and line.startswith(problem)


@pytest.fixture(autouse=True)
def interruptible():
    """A shell's background job ignores Ctrl-C, and so would the tests and their programs."""
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, previous)


class Callback:
    """Its finaliser is a callback: Python drops what a signal handler raises in it."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_in_callbacks_are_not_lost(number):
    with pytest.raises(KeyboardInterrupt) as stopped, cli._stop_at_signals():
        Callback(number)
        time.sleep(5)
        raise AssertionError(f"{number.name} was lost")
    assert getattr(stopped.value, "signal", signal.SIGINT) == number


IMPORTED = """
import os, time
os.kill(os.getpid(), {number})
time.sleep(0.1)
complete = True
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_signals_wait_for_the_end_of_an_import(number, tmp_path, monkeypatch):
    (tmp_path / "interrupted.py").write_text(IMPORTED.format(number=int(number)))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "interrupted", raising=False)
    with pytest.raises(KeyboardInterrupt), cli._stop_at_signals():
        importlib.import_module("interrupted")
        time.sleep(5)
        raise AssertionError(f"{number.name} was lost")
    assert sys.modules["interrupted"].complete


def test_signals_wait_until_orbax_has_closed_its_event_loop():
    events = []

    async def read():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)  # Blocks the loop; a signal would raise here.
        events.append("read")

    with pytest.raises(cli.Stopped), cli._stop_at_signals():
        asyncio_utils.run_sync(read())
        time.sleep(5)
        raise AssertionError("SIGTERM was lost")
    assert events == ["read"]


def test_signals_wait_until_a_removed_semaphore_is_forgotten(monkeypatch):
    """Else Python's process that removes semaphores warns of a leaked one."""
    unlink, unregister, forgotten = synchronize.sem_unlink, resource_tracker.unregister, []

    def unlink_and_stop(name):
        unlink(name)
        os.kill(os.getpid(), signal.SIGTERM)

    def note(name, kind):
        unregister(name, kind)
        forgotten.append(kind)

    monkeypatch.setattr(synchronize, "sem_unlink", unlink_and_stop)
    monkeypatch.setattr(resource_tracker, "unregister", note)
    with pytest.raises(cli.Stopped), cli._stop_at_signals():
        multiprocessing.get_context("spawn").Lock()
        time.sleep(5)
        raise AssertionError("SIGTERM was lost")
    assert forgotten == ["semaphore"]


def test_import_that_never_ends_is_interrupted(tmp_path, monkeypatch):
    (tmp_path / "endless.py").write_text(
        "import os, time\nos.kill(os.getpid(), 15)\nwhile True: time.sleep(9)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(cli, "_PATIENCE_S", 0.2)
    with pytest.raises(cli.Stopped), cli._stop_at_signals():
        importlib.import_module("endless")


def test_two_signals_in_an_import_wake_the_main_thread(tmp_path, monkeypatch):
    numbers = [int(signal.SIGINT), int(signal.SIGTERM)]
    code = f"import os, time\nfor number in {numbers}: os.kill(os.getpid(), number)\ntime.sleep(0.1)\n"
    (tmp_path / "both.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), cli._stop_at_signals():
        importlib.import_module("both")
        time.sleep(20)
    assert time.monotonic() - started < 10


def test_two_signals_at_once_leave_none_ignored():
    """The second one must not interrupt the removal of the handlers."""
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    previous = [signal.getsignal(number) for number in numbers]
    with pytest.raises(KeyboardInterrupt), cli._stop_at_signals():
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        for number in numbers:
            signal.pthread_kill(threading.get_ident(), number)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        time.sleep(5)
    assert [signal.getsignal(number) for number in numbers] == previous


def test_interrupt_at_exit_prints_no_traceback():
    """The function runs at Python's exit, as those of JAX do."""
    code = "import atexit, time; atexit.register(lambda: (print(flush=True), time.sleep(20)))"
    command = [sys.executable, "-c", f"{code}; from drivax.cli import main; main()", "--version"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("drivax ") and process.stdout.readline() == "\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=10)[1] == "" and process.returncode == -signal.SIGINT


@pytest.mark.parametrize(
    ("enabled", "tunables", "is_started_again"),
    [
        ("always [madvise] never", None, True),
        ("always [madvise] never", "glibc.malloc.check=1", False),
        ("always madvise [never]", None, False),
        (None, None, False),
    ],
)
def test_training_starts_again_where_huge_pages_are_granted_on_request(
    enabled: str | None, tunables: str | None, is_started_again: bool, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    calls: list[Any] = []
    file = tmp_path / "enabled"
    if enabled is not None:
        file.write_text(enabled)
    monkeypatch.setattr(cli, "_HUGE_PAGES", file)
    monkeypatch.setattr(os, "execv", lambda *call: calls.append(call))
    monkeypatch.setattr(sys, "argv", ["drivax", "train", "--help"])
    monkeypatch.setattr(sys, "orig_argv", ["python3", "-u", "/bin/drivax", "train", "--help"])
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if tunables is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", tunables)
    assert cli.main() == 0
    again = [(sys.executable, [sys.executable, "-u", "/bin/drivax", "train", "--help"])]
    assert calls == (again if is_started_again else [])
    assert os.environ.get("GLIBC_TUNABLES") == ("glibc.malloc.hugetlb=1" if is_started_again else tunables)
