"""Damaged and hostile files: every reader ends in one line, or reads them as data.

Each run tries 50 files of a format and 15 of a kind that drivax writes, the slow one 10,000 and 1,200.
"""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from drivax.datasets.formats import READERS

FORMATS = [reader.name for reader in READERS]
OWN = ["set", "table", "run", "training", "policy", "study", "export", "partial"]


def _run(repository, *arguments: object) -> str:
    command = [sys.executable, "-m", *map(str, arguments)]
    done = subprocess.run(command, cwd=repository / "tests", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_end_in_a_clear_error_or_a_sound_scenario(repository, name):
    ends = _run(repository, "fuzz.run", name, "--files", 50)
    assert '"bad record"' in ends or '"error"' in ends, "no damage was noticed: the damage is too gentle"


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_ten_thousand_damaged_files(repository, name):
    _run(repository, "fuzz.run", name, "--files", 10_000, "--seed", 1)


def test_damaged_own_files_are_detected_or_unchanged(repository):
    for line in _run(repository, "fuzz.own_files", *OWN, "--files", 15).splitlines():
        noticed = re.search(r'"detected"|"changed": [1-9]', line)
        assert noticed, "no damage was noticed: the damage is too gentle"


@pytest.mark.slow
@pytest.mark.parametrize("kind", OWN)
def test_1200_damaged_own_files(repository, kind):
    _run(repository, "fuzz.own_files", kind, "--files", 1200, "--seed", 1)


@pytest.mark.slow
@pytest.mark.parametrize("place", [*OWN, *FORMATS])
def test_hostile_files_are_read_as_data(repository, place):
    assert '"executed"' not in _run(repository, "fuzz.hostile", "--places", place)
