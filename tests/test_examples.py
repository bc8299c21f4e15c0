"""The scripts in ``examples/`` run and print a result."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))


def test_there_are_five_examples():
    assert [file.stem for file in EXAMPLES] == [
        "offline_rl",
        "own_data",
        "own_loop",
        "own_planner",
        "own_reward",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_example_runs_and_prints_a_result(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    runpy.run_path(str(file), run_name="__main__")
    assert capsys.readouterr().out.strip()
