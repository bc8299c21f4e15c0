"""Every reader survives damaged files: 50 in each run, 10,000 in the slow one."""

from __future__ import annotations

import subprocess
import sys

import pytest

from drivax.datasets.formats import READERS

FORMATS = [reader.name for reader in READERS]


def _run(repository, name: str, files: int, seed: int) -> str:
    command = [sys.executable, "-m", "fuzz.run", name, "--files", str(files), "--seed", str(seed)]
    done = subprocess.run(command, cwd=repository / "tests", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_end_in_a_clear_error_or_a_sound_scenario(repository, name):
    ends = _run(repository, name, files=50, seed=0)
    assert '"bad record"' in ends or '"error"' in ends, "no damage was noticed: the damage is too gentle"


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_ten_thousand_damaged_files(repository, name):
    _run(repository, name, files=10_000, seed=1)
