"""The demo, small."""

import json

import pytest

from drivax.cli import main
from drivax.studies.demo import REFERENCES


@pytest.mark.slow
def test_demo_writes_a_report_and_never_overwrites(tmp_path, capsys):
    out = tmp_path / "demo"
    sizes = ["--training", "4", "--held-out", "3", "--steps", "8192", "--workers", "1"]
    assert main(["demo", "--out", str(out), *sizes]) == 0
    assert "report: " in capsys.readouterr().out
    result = json.loads((out / "demo.json").read_text())
    assert [row["planner"] for row in result["summaries"]] == [*REFERENCES, "policy"]
    expert = result["summaries"][0]["metrics"]
    assert expert["accuracy"]["mean"] == expert["success"]["mean"] == 1.0 and expert["accuracy"]["n"] == 3
    assert set(result["policy_minus"]) == set(REFERENCES)
    assert (out / "report.html").stat().st_size > 50_000
    assert main(["demo", "--out", str(out), *sizes]) == 2
    assert "--overwrite" in capsys.readouterr().err
