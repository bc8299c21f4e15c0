"""Output files and folders: refusals, atomic writes, and folders that can be resumed."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from drivax.errors import DataError, UsageError
from drivax.files import (
    PartialFolder,
    atomic_write,
    can_resume,
    check_output,
    check_space,
    explain_full_disk,
    format_bytes,
    free_bytes,
    replace_folder,
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
        explain_full_disk(tmp_path / "set", needed=3_000_000),
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
