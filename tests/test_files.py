"""Output files and folders: refusals, atomic writes, and folders that can be resumed."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from drivax import files
from drivax.errors import DataError, UsageError, explain_library, explain_system, missing_package
from drivax.files import (
    PartialFolder,
    allow_open_files,
    atomic_write,
    can_resume,
    check_output,
    check_space,
    explain_full_disk,
    format_bytes,
    free_bytes,
    inside,
    parse_bytes,
    replace_folder,
    restore_folder,
    write_json,
    write_text,
)


def names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}


def test_check_output_accepts_a_new_name_and_what_may_be_overwritten(tmp_path: Path):
    (tmp_path / "file").touch()
    check_output(tmp_path / "new", overwrite=False)
    check_output(tmp_path / "new", overwrite=False, folder=True)
    check_output(tmp_path / "file", overwrite=True)
    check_output(tmp_path, overwrite=True, folder=True)


@pytest.mark.parametrize(
    ("folder", "overwrite", "message"),
    [
        (False, False, "output file already exists; choose another or pass --overwrite"),
        (True, True, "output is a file; name a folder to write"),
        (True, False, "output is a file; name a folder to write"),
    ],
)
def test_check_output_refuses_an_existing_file(tmp_path: Path, folder: bool, overwrite: bool, message: str):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError) as error:
        check_output(tmp_path / "file", overwrite, folder=folder)
    assert message in str(error.value)


def test_check_output_refuses_an_existing_folder(tmp_path: Path):
    with pytest.raises(UsageError, match="output folder already exists"):
        check_output(tmp_path, overwrite=False, folder=True)
    with pytest.raises(UsageError, match="output is a folder; name a file to write"):
        check_output(tmp_path, overwrite=True)


def test_an_atomic_write_appears_when_it_is_complete(tmp_path: Path):
    file = tmp_path / "new" / "file"
    with atomic_write(file) as opened:
        opened.write(b"content")
        assert not file.exists()
    assert file.read_bytes() == b"content"
    assert names(file.parent) == {"file"}


def test_a_failed_atomic_write_keeps_the_old_file(tmp_path: Path):
    write_text(tmp_path / "file", "old")
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "file") as opened:
        opened.write(b"new")
        raise ZeroDivisionError
    assert (tmp_path / "file").read_text() == "old"
    assert names(tmp_path) == {"file"}


def test_json_is_strict(tmp_path: Path):
    write_json(tmp_path / "file", {"a": [1, 0.5, None]})
    assert json.loads((tmp_path / "file").read_text()) == {"a": [1, 0.5, None]}
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "file", float("nan"))
    assert names(tmp_path) == {"file"}


def test_replace_folder_replaces_the_whole_folder(tmp_path: Path):
    write_text(tmp_path / "run" / "old", "")
    with replace_folder(tmp_path / "run") as partial:
        write_text(partial / "new", "")
        assert names(tmp_path / "run") == {"old"}
    assert names(tmp_path / "run") == {"new"}
    assert names(tmp_path) == {"run"}


def test_replace_folder_keeps_the_old_one_after_an_error(tmp_path: Path):
    write_text(tmp_path / "run" / "old", "")
    with pytest.raises(ZeroDivisionError), replace_folder(tmp_path / "run"):
        raise ZeroDivisionError
    assert names(tmp_path / "run") == {"old"}
    assert names(tmp_path) == {"run"}


def started(path: Path, identity: dict[str, int] | None = None) -> PartialFolder:
    """A folder with one finished part, closed before it was published."""
    folder = PartialFolder(path, identity)
    assert folder.open() == []
    (folder.content / "part").touch()
    folder.note(0, {"part": "first"})
    folder.close()
    return folder


def test_a_partial_folder_resumes_after_its_finished_parts(tmp_path: Path):
    started(tmp_path / "set", {"seed": 1})
    assert can_resume(tmp_path / "set")
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert folder.open() == [{"part": "first"}]
    folder.publish()
    folder.close()
    assert names(tmp_path) == {"set"}
    assert names(tmp_path / "set") == {"part"}
    assert not can_resume(tmp_path / "set")


def test_temporary_files_of_a_killed_writer_are_removed_on_resume(tmp_path: Path):
    spool = started(tmp_path / "set", {"seed": 1}).root / f"spool-{os.getpid()}"
    write_text(spool / "0.records", "")
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert folder.open() == [{"part": "first"}]
    assert names(folder.root) == {"content", "progress", "identity.json", "lock"}
    folder.close()


def test_replaced_folder_is_removed_after_a_resumable_writer(tmp_path: Path):
    write_text(tmp_path / "set" / "old", "")
    started(tmp_path / "set", {"seed": 1})
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    folder.open()
    folder.publish()
    folder.close()
    assert names(tmp_path) == {"set"} and names(tmp_path / "set") == {"part"}


def test_a_partial_folder_without_identity_leaves_nothing_behind(tmp_path: Path):
    started(tmp_path / "set")
    assert names(tmp_path) == set()


def test_a_partial_folder_of_another_identity_needs_a_restart(tmp_path: Path):
    started(tmp_path / "set", {"seed": 1})
    folder = PartialFolder(tmp_path / "set", {"seed": 2})
    with pytest.raises(UsageError, match=r"started with other data or other options \(seed\)"):
        folder.open()
    assert folder.open(restart=True) == []
    assert names(folder.content) == set()
    folder.close()


def test_a_partial_folder_has_one_writer_at_a_time(tmp_path: Path):
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    folder.open()
    with pytest.raises(UsageError, match="another process is writing it"):
        PartialFolder(tmp_path / "set", {"seed": 1}).open()
    folder.close()
    assert names(tmp_path) == set()


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
        OSError(errno.EDQUOT, os.strerror(errno.EDQUOT)),
        ValueError(
            "RESOURCE_EXHAUSTED: Failed to write 305 bytes to file 9: No space left on device [os_error_code='28']"
        ),
    ],
)
def test_a_full_disk_is_reported_with_path_need_and_cure(tmp_path: Path, error: Exception):
    with (
        pytest.raises(
            DataError, match=r"set: no space left on device \(.+ free, of about 3\.0 MB needed\); make"
        ),
        explain_full_disk(tmp_path / "set", size=3_000_000),
    ):
        raise error


def test_of_nested_blocks_the_outermost_names_the_output(tmp_path: Path):
    with (
        pytest.raises(DataError, match=r"^\S+/set: no space left on device \([^,]+ free, more needed\)"),
        explain_full_disk(tmp_path / "set"),
        atomic_write(tmp_path / "set" / "manifest.json"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_an_output_reports_the_need_of_a_file_in_it(tmp_path: Path):
    with (
        pytest.raises(
            DataError, match=r"^\S+/run: no space left on device \(.+ free, of about 12 kB needed\)"
        ),
        explain_full_disk(tmp_path / "run"),
        replace_folder(tmp_path / "run" / "checkpoint"),
        atomic_write(tmp_path / "run" / "checkpoint" / "weights", 12_000),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_write_larger_than_its_limit_reports_the_size_of_the_file(tmp_path: Path):
    """A text of 100 kB where files may have 10 kB: the system's own error, with EFBIG in place of ENOSPC."""
    code = """
import errno, resource, signal, sys
from pathlib import Path
from drivax import files
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
errno.ENOSPC = errno.EFBIG
files.write_text(Path(sys.argv[1]), "x" * 100_000)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "log"], capture_output=True, text=True, check=False
    )
    assert re.search(r"log: no space left on device \(.+ free, of about 100 kB needed\); make", done.stderr)
    assert names(tmp_path) == set()


def test_a_partial_folder_that_cannot_start_leaves_nothing_behind(tmp_path: Path, monkeypatch):
    def full(path: Path, value: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("drivax.files.write_json", full)
    with pytest.raises(OSError):
        PartialFolder(tmp_path / "set", {"seed": 1}).open()
    assert names(tmp_path) == set()


def test_other_errors_of_the_system_pass_unchanged(tmp_path: Path):
    with pytest.raises(PermissionError), explain_full_disk(tmp_path / "set"):
        raise PermissionError(errno.EACCES, "Permission denied")


def test_a_full_disk_during_an_atomic_write_keeps_the_old_file(tmp_path: Path):
    path = tmp_path / "value.json"
    write_json(path, 1)
    with pytest.raises(DataError, match=r"value\.json: no space left on device"), atomic_write(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert json.loads(path.read_text()) == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["value.json"]


def test_space_is_checked_on_the_disk_of_a_folder_that_does_not_exist_yet(tmp_path: Path):
    out = tmp_path / "sets" / "world"
    check_space(out, free_bytes(tmp_path) // 2)
    with pytest.raises(
        DataError, match=r"world: no space: needs about .+, the disk has .+ left; use --limit"
    ):
        check_space(out, 1 << 60, cure="use --limit")


@pytest.mark.parametrize(
    ("size", "text"), [(999, "999 bytes"), (54_321, "54 kB"), (6.61e9, "6.6 GB"), (4.123e13, "41 TB")]
)
def test_sizes_are_readable(size: float, text: str):
    assert format_bytes(size) == text


def test_sizes_are_read_with_their_unit():
    assert [parse_bytes(text) for text in ("540kB", "6.6 GB", " 2TB ")] == [
        540_000,
        6_600_000_000,
        2 * 10**12,
    ]
    for text in ("2", "GB", "2gb", "-1GB", "1e3MB", ""):
        with pytest.raises(UsageError, match=r"invalid size .*; use a number and a unit: 800MB, 2GB"):
            parse_bytes(text)


# --- Kills and links.


def run(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


#: Replaces a folder, and is killed after its first rename.
REPLACE = """
import os, sys
from pathlib import Path
from drivax import files
rename = Path.rename
def rename_and_die(self, target):
    rename(self, target)
    os.kill(os.getpid(), 9)
Path.rename = rename_and_die
if sys.argv[2] == "old disk":
    files._exchange = lambda first, second: False
with files.replace_folder(Path(sys.argv[1])) as partial:
    (partial / "new").touch()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux exchanges two folders")
def test_exchange_needs_no_rename_after_which_the_folder_is_missing(tmp_path: Path):
    write_text(tmp_path / "run" / "old", "")
    assert run(REPLACE, tmp_path / "run", "new disk").returncode == 0
    assert names(tmp_path / "run") == {"new"} and names(tmp_path) == {"run"}


def test_folder_gets_its_name_back_after_a_kill_between_renames(tmp_path: Path):
    write_text(tmp_path / "run" / "old", "")
    assert run(REPLACE, tmp_path / "run", "old disk").returncode == -signal.SIGKILL
    assert not (tmp_path / "run").exists()
    restore_folder(tmp_path / "run")
    assert names(tmp_path / "run") == {"old"} and names(tmp_path) == {"run"}
    with replace_folder(tmp_path / "run") as partial:
        write_text(partial / "newer", "")
    assert names(tmp_path / "run") == {"newer"} and names(tmp_path) == {"run"}


def test_read_passes_where_the_folder_cannot_get_its_name_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(self: Path, target: Path):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    (tmp_path / ".run.partial" / "old").mkdir(parents=True)
    monkeypatch.setattr(Path, "rename", refuse)
    restore_folder(tmp_path / "run")
    assert names(tmp_path / ".run.partial") == {"lock", "old"}
    monkeypatch.undo()
    restore_folder(tmp_path / "run")  # The lock is free.
    assert names(tmp_path) == {"run"}


def test_error_between_renames_keeps_the_old_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_text(tmp_path / "run" / "old", "")
    monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    rename = Path.rename

    def fail_second(self: Path, target: Path):
        if self.name == "content":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_second)
    with pytest.raises(KeyboardInterrupt), replace_folder(tmp_path / "run") as partial:
        write_text(partial / "new", "")
    assert names(tmp_path / "run") == {"old"} and names(tmp_path) == {"run"}


@pytest.mark.parametrize("kind", ["replace_folder", "atomic_write"])
def test_next_success_takes_over_what_a_killed_process_left(tmp_path: Path, kind: str):
    code = f"""
import os, sys
from pathlib import Path
from drivax import files
with files.{kind}(Path(sys.argv[1])) as partial:
    (partial / "half").touch() if isinstance(partial, Path) else partial.write(b"a long half")
    os.kill(os.getpid(), 9)
"""
    assert run(code, tmp_path / "out").returncode == -signal.SIGKILL
    assert names(tmp_path) == {".out.partial"}
    if kind == "atomic_write":
        write_text(tmp_path / "out", "new")
        assert (tmp_path / "out").read_text() == "new"
    else:
        with replace_folder(tmp_path / "out") as partial:
            write_text(partial / "new", "")
        assert names(tmp_path / "out") == {"new"}
    assert names(tmp_path) == {"out"}


def test_symbolic_links_to_outputs_are_followed(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    for name in ("file", "run"):
        (tmp_path / name).symlink_to(tmp_path / "disk" / name)
    for text in ("old", "new"):
        write_text(tmp_path / "file", text)
        with replace_folder(tmp_path / "run") as partial:
            write_text(partial / text, "")
    assert (tmp_path / "file").is_symlink() and (tmp_path / "run").is_symlink()
    assert (tmp_path / "disk" / "file").read_text() == "new"
    assert names(tmp_path / "disk") == {"file", "run"} and names(tmp_path / "disk" / "run") == {"new"}


def test_symbolic_links_under_hidden_names_are_not_followed(tmp_path: Path):
    victim = tmp_path / "victim"
    write_text(victim / "file", "kept")
    (tmp_path / ".file.partial").symlink_to(victim / "file")
    write_text(tmp_path / "file", "new")
    (tmp_path / ".run.partial").symlink_to(victim)
    with replace_folder(tmp_path / "run") as partial:
        write_text(partial / "new", "")
    (tmp_path / ".set.partial").mkdir()
    for name in ("content", "progress", "old", "spool-1", "lock"):
        (tmp_path / ".set.partial" / name).symlink_to(victim)
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    folder.open()
    folder.note(0, {})
    folder.publish()
    folder.close()
    assert names(tmp_path) == {"victim", "file", "run", "set"}
    assert names(victim) == {"file"} and (victim / "file").read_text() == "kept"


def test_links_inside_a_folder_are_refused(tmp_path: Path):
    (tmp_path / "link").symlink_to(tmp_path)
    assert inside(tmp_path / "link", "new", "file") == tmp_path / "link" / "new" / "file"
    for names in (("link",), ("link", "file"), ("dangling",)):
        if names == ("dangling",):
            (tmp_path / "dangling").symlink_to(tmp_path / "missing")
        with pytest.raises(
            DataError, match=f"{names[0]}: is a symbolic link; replace the link with its target"
        ):
            inside(tmp_path, *names)


def test_failure_removes_the_parents_that_it_created(tmp_path: Path):
    with pytest.raises(ZeroDivisionError), replace_folder(tmp_path / "a" / "b" / "run"):
        raise ZeroDivisionError
    assert names(tmp_path) == set()


def test_unfinished_output_of_another_command_is_not_discarded(tmp_path: Path):
    started(tmp_path / "set", {"seed": 1})
    with pytest.raises(UsageError, match=r"other options \(command\); finish it"):
        PartialFolder(tmp_path / "set").open()
    assert can_resume(tmp_path / "set")


def test_changed_note_does_not_count(tmp_path: Path):
    started(tmp_path / "set", {"seed": 1})
    note = tmp_path / ".set.partial" / "progress" / "00000.json"
    note.write_text(note.read_text().replace("first", "other"))
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert folder.open() == []
    folder.close()


def test_note_of_another_number_does_not_count(tmp_path: Path):
    first = started(tmp_path / "set", {"seed": 1}).root / "progress" / "00000.json"
    first.with_name("00001.json").write_bytes(first.read_bytes())
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert len(folder.open()) == 1
    folder.close()


#: Makes what drivax never writes under a hidden name.
LITTER = {
    "garbage": lambda path: path.write_bytes(b"\xff\0{["),
    "large number": lambda path: path.write_text("1" * 10_000),
    "nested": lambda path: path.write_text("[" * 100_000),
    "sparse": lambda path: (path.touch(), os.truncate(path, 1 << 40)),
    "folder": lambda path: (path / "entry").mkdir(parents=True),
    "pipe": os.mkfifo,
    "link": lambda path: path.symlink_to("/etc/hostname"),
    "circular link": lambda path: path.symlink_to(path.name),
}


@pytest.fixture
def alarm():
    """Raise TimeoutError in a test that waits for a pipe."""

    def ring(*_: object):
        raise TimeoutError

    former = signal.signal(signal.SIGALRM, ring)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


LOADS = json.loads


@pytest.mark.parametrize("kind", LITTER)
@pytest.mark.parametrize(
    "name", ["", "lock", "identity.json", "progress", "progress/00000.json", "content", "old"]
)
def test_litter_under_hidden_names_is_replaced(tmp_path: Path, kind: str, name: str, alarm: None):
    for use in ("resume", "replace", "restore", "write a file"):
        path = tmp_path / use / "out"
        litter = started(path, {"seed": 1}).root / name
        files.remove(litter)
        LITTER[kind](litter)
        if use == "resume":
            folder = PartialFolder(path, {"seed": 1})
            for number in range(len(folder.open()), 2):
                folder.note(number, {})
            folder.publish()
            folder.close()
        elif use == "write a file" and not can_resume(path):
            write_text(path, "")
        elif use == "replace":
            with replace_folder(path):
                pass
        else:
            restore_folder(path)
            continue
        assert names(path.parent) == {"out"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("identity.json", '{"seed": 1}' + " " * (1 << 20)),
        ("progress/00000.json", f"[{'[0],' * (3 << 20)}0]"),
    ],
)
def test_large_identities_and_notes_of_many_values_start_again(
    tmp_path: Path, monkeypatch, name: str, text: str
):
    root = started(tmp_path / "set", {"seed": 1}).root
    (root / name).write_text(text)
    monkeypatch.setattr(
        json, "loads", lambda data: pytest.fail("parsed") if len(data) >= 1 << 20 else LOADS(data)
    )
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert folder.open() == []
    folder.close()


def test_notes_after_the_intact_ones_are_removed(tmp_path: Path):
    progress = started(tmp_path / "set", {"seed": 1}).root / "progress"
    (progress / "00001.json").mkdir()
    folder = PartialFolder(tmp_path / "set", {"seed": 1})
    assert folder.open() == [{"part": "first"}]
    folder.note(1, {})
    assert names(progress) == {"00000.json", "00001.json"}
    folder.close()


def test_file_does_not_replace_the_unfinished_folder_of_another_command(tmp_path: Path):
    folder = PartialFolder(tmp_path / "out", {"seed": 1})
    folder.open()
    with pytest.raises(UsageError, match="another process is writing it"):
        write_text(tmp_path / "out", "")
    folder.note(0, {})
    folder.close()
    with pytest.raises(UsageError, match="an unfinished output was started with other data"):
        write_text(tmp_path / "out", "")
    assert can_resume(tmp_path / "out")


# --- Errors of the system.


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (errno.EROFS, "x: read-only file system; choose a folder on a disk that can be written"),
        (errno.EACCES, "x: permission denied; change the permissions"),
        (errno.ENOENT, "x: no such file or directory; check the path"),
        (errno.ESTALE, "x: stale file handle; mount the disk again"),
        (errno.EIO, "x: input/output error; mount the disk again"),
        (errno.ENOSPC, "x: no space left on device; make room"),
    ],
)
def test_system_error_has_path_and_cure(number: int, text: str):
    error = explain_system(OSError(number, os.strerror(number), "x"))
    assert isinstance(error, DataError) and str(error).startswith(text)
    assert str(explain_system(OSError(number, os.strerror(number)), "x")) == str(error)
    quoted = ValueError(f"INVALID_ARGUMENT: Failed to write: {text} [os_error_code='{number}']")
    assert f"x: {explain_library(quoted)}" == str(error)
    assert explain_system(quoted) is None, "a file of a stranger may contain these words"


def test_file_system_without_bytes_says_itself_why_it_is_not_written():
    check_space(Path("/proc/drivax"), 1 << 30)


def test_limits_of_the_process_are_named_with_their_value(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("resource.getrlimit", lambda kind: (2048, 4096))
    for error, text in (
        (
            OSError(errno.EMFILE, "x"),
            "too many open files (limit of open files: 2048); raise the limit: ulimit -n 4096, or",
        ),
        (MemoryError(), "cannot allocate memory (limit of memory in kB: 2); use fewer --workers"),
        (
            RuntimeError("can't start new thread"),
            "(limit of processes and threads: 2048); raise the limit: ulimit -u 4096, or",
        ),
        (ValueError("Failed to open file 9: x [os_error_code='24']"), "limit of open files: 2048); raise"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 13743895347 bytes."),
            "cannot allocate memory (limit of memory in kB: 2); use fewer --workers",
        ),
    ):
        explained = explain_system(error) or explain_library(error)
        assert isinstance(explained, UsageError) and text in str(explained)
    assert explain_system(ValueError("x")) is None and explain_system(RuntimeError("x")) is None


def test_only_a_package_that_is_not_installed_is_missing():
    missing = missing_package(ModuleNotFoundError("no module", name="av"))
    assert missing is not None and missing.cure == "pip install 'drivax[show]'"
    missing = missing_package(ModuleNotFoundError("no module", name="google.protobuf.message"))
    assert str(missing) == "protobuf is not installed; pip install 'drivax[womd]'"
    assert missing_package(ModuleNotFoundError("no module", name="not_there")) is None
    assert missing_package(ImportError("libavformat.so: not found", name="av._core")) is None


def test_hidden_names_are_those_of_the_output(tmp_path: Path):
    error = OSError(errno.EROFS, os.strerror(errno.EROFS), str(tmp_path / ".set.partial" / "lock"))
    with pytest.raises(OSError, match=r"set'$"), explain_full_disk(tmp_path / "set"):
        raise error


def test_limit_of_open_files_is_raised_or_reported(tmp_path: Path):
    code = """
import resource, sys
from pathlib import Path
from drivax.files import allow_open_files
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 300))
allow_open_files(Path("set"), 100)
assert resource.getrlimit(resource.RLIMIT_NOFILE) == (228, 300)
allow_open_files(Path("set"), 1000)
"""
    result = run(code)
    assert "set: needs 1128 open files, the limit is 300; raise it: ulimit -Hn 1128" in result.stderr
    allow_open_files(tmp_path, 1)
