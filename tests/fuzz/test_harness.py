"""The fuzz can fail: readers that are broken on purpose are found, and sound ones are not."""

from __future__ import annotations

import ast
import time
from pathlib import Path

import numpy as np
import pytest

from drivax.errors import DataError, UsageError, explain_system
from drivax.reading import explain_damage
from fuzz import hostile, own_files
from fuzz.limits import attempt

FILE, CURE = Path("a.txt"), "restore it"
MEGABYTES = 1 << 20


def hog() -> tuple[str, None]:
    """Takes 100 MB and refuses the file."""
    np.ones(100 * MEGABYTES, np.uint8)
    raise DataError("is damaged", file=FILE, cure=CURE)


def swallow() -> tuple[str, None]:
    """Takes 100 MB, and says nothing about it."""
    np.ones(100 * MEGABYTES, np.uint8)
    return "read", None


def give_up() -> tuple[str, None]:
    """Reports that memory was not enough as damage, in one line."""
    try:
        raise MemoryError
    except MemoryError as error:
        raise explain_system(error, FILE) or error from error


def hide() -> tuple[str, None]:
    """Calls a lack of memory something else."""
    try:
        raise MemoryError
    except MemoryError as error:
        raise DataError("is damaged", file=FILE, cure=CURE) from error


def crash() -> tuple[str, None]:
    raise ZeroDivisionError


def run_out() -> tuple[str, None]:
    np.empty(1 << 55, np.uint8)
    return "read", None


def wait() -> tuple[str, None]:
    time.sleep(20)
    return "read", None


def wait_in_vain() -> tuple[str, None]:
    """Takes the alarm for an error of the file."""
    try:
        time.sleep(20)
    except BaseException:
        return "read", None
    return "read", None


def refuse_without_cure() -> tuple[str, None]:
    raise DataError("is damaged", file=FILE)


def refuse_at_length() -> tuple[str, None]:
    raise UsageError("x" * 900, file="y" * 2000, cure=CURE)


@pytest.mark.parametrize(
    ("read", "end"),
    [
        (hog, "memory"), (swallow, "memory"), (give_up, "memory"), (hide, "memory"), (run_out, "memory"),
        (crash, "traceback"), (wait, "hang"), (wait_in_vain, "hang"),
        (refuse_without_cure, "refused"), (refuse_at_length, "refused"),
    ],
)  # fmt: skip
def test_broken_readers_are_found(read, end):
    found, problem = attempt(read, "refused", seconds=1.0, memory=50 * MEGABYTES)
    assert found == end and problem


def refuse() -> tuple[str, None]:
    raise DataError("is damaged", file=FILE, cure=CURE)


def refuse_depth() -> tuple[str, None]:
    """Python's parser raises a MemoryError for deep nesting, without taking memory."""
    with explain_damage(FILE, CURE):
        try:
            ast.literal_eval("-" * 60_000 + "1")
        except MemoryError as error:
            raise ValueError("nested too deeply") from error
    return "read", None


@pytest.mark.parametrize(
    ("read", "end"), [(lambda: ("read", None), "read"), (refuse, "refused"), (refuse_depth, "refused")]
)
def test_sound_readers_pass(read, end):
    assert attempt(read, "refused", seconds=5.0, memory=50 * MEGABYTES) == (end, None)


def test_memory_of_earlier_readings_does_not_count():
    """Peaks are those of one reading."""
    for _ in range(2):
        assert attempt(hog, "refused", memory=50 * MEGABYTES)[0] == "memory"
        assert attempt(refuse, "refused", memory=50 * MEGABYTES) == ("refused", None)


def test_code_in_files_is_found(tmp_path):
    def execute(folder: Path) -> None:
        hostile.CANARY.touch()
        raise DataError("is damaged", file=folder, cure=CURE)

    assert hostile.outcome(execute, tmp_path)[0] == "executed"
    assert hostile.outcome(lambda folder: None, tmp_path) == ("read", None)


def test_silent_changes_are_found(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("1")
    expected = own_files.content("1")

    def read(folder: Path) -> str:
        return (folder / "a.txt").read_text()

    assert own_files.outcome(read, tmp_path, expected, editable=False) == ("identical", None)
    file.write_text("2")
    assert own_files.outcome(read, tmp_path, expected, editable=False)[1] == "read with another content"
    assert own_files.outcome(read, tmp_path, expected, editable=True) == ("changed", None)


@pytest.mark.parametrize("kind", own_files.KINDS)
def test_samples_read_as_they_are_also_as_edited(kind, tmp_path):
    """Else damage would be found in what is whole."""
    write, read = own_files.KINDS[kind]
    write(tmp_path)
    expected = own_files.content(read(tmp_path))
    assert own_files.outcome(read, tmp_path, expected, False, edited=True) == ("identical", None)
