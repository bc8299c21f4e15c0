"""Scripts that measure speed: what they store when a measurement fails, and ratios of two trees."""

from __future__ import annotations

import json

import pytest

from drivax.tracking.workers import available_cores
from experiment_scripts import load_script


@pytest.fixture
def ratios():
    return load_script("speed.ratios")


def test_gpu_script_keeps_what_it_has(tmp_path):
    gpu = load_script("gpu")
    recorder = gpu.Recorder(tmp_path / "gpu.json", seconds=60)

    def out_of_memory():
        raise MemoryError("no  room")

    recorder.measure("simulation", "first", lambda: {"steps_per_second": 2})
    recorder.measure("simulation", "second", out_of_memory)
    recorder.start_s -= 0.5 * 60
    recorder.measure("simulation", "third", lambda: pytest.fail("ran after the stage's time"))
    recorder.measure("training", "ppo", lambda: 3)
    assert json.loads((tmp_path / "gpu.json").read_text()) == {
        "simulation": {"first": {"steps_per_second": 2}, "second": "failed: no room", "third": "not run"},
        "training": {"ppo": 3},
    }


def test_ratio_of_two_trees_is_that_of_their_work(ratios, tmp_path):
    program = "import time\nimport drivax\ndef call():\n    time.sleep(0.02 * drivax.COST)\n    return 1"
    for name, cost in (("before", 3), ("after", 1)):
        (tmp_path / name / "src").mkdir(parents=True)
        (tmp_path / name / "src" / "drivax.py").write_text(f"COST = {cost}")
    sides = [ratios.Side(tmp_path / name) for name in ("before", "after")]
    row = ratios.repeated(ratios.Repeated("calls/s", program), sides, tmp_path, 3)
    assert row["ratio"] == pytest.approx(3, rel=0.2)
    assert row["before"] == pytest.approx(1 / 0.06, rel=0.2)


def test_side_on_one_core_is_pinned_to_it(ratios, tmp_path):
    program = "import os, time\ndef call():\n    time.sleep(0.05)\n    return len(os.sched_getaffinity(0))"
    sides = [ratios.Side(tmp_path, one_core=one_core) for one_core in (True, False)]
    row = ratios.repeated(ratios.Repeated("cores/s", program), sides, tmp_path, 3)
    assert row["ratio"] == pytest.approx(len(available_cores()), rel=0.3)


def test_row_of_a_command_has_the_ratios_of_its_pairs_and_their_interval():
    """Of nine pairs, the second least and the second largest ratio: the median is outside with probability 0.04."""
    pairs = [(2.0, 2.0 + number / 10) for number in (8, 0, 1, 2, 3, 4, 5, 6, 7)]
    row = load_script("speed.commands").row(pairs)
    assert row == {"before_s": 2.0, "after_s": 2.4, "time_ratio": 1.2, "low": 1.05, "high": 1.35}


def test_failed_program_is_an_error(ratios, tmp_path):
    with pytest.raises(SystemExit, match="failed"):
        side = ratios.Side(tmp_path)
        ratios.Worker(side, "def call(): raise ValueError", tmp_path, tmp_path, str(tmp_path)).run()


def test_without_kernels_there_is_nothing_to_compare(ratios, tmp_path, monkeypatch):
    monkeypatch.setattr(ratios, "measure", lambda *_: pytest.fail("measured XLA against XLA"))
    monkeypatch.setattr("sys.argv", ["ratios", "--data", str(tmp_path), "--kernels"])
    monkeypatch.setenv("DRIVAX_NATIVE", "0")
    with pytest.raises(SystemExit, match="nothing to compare with kernels: none, since DRIVAX_NATIVE=0"):
        ratios.main()


def test_rows_show_their_conditions(ratios):
    name = "PPO training"
    row = {
        "ratio": 1.5,
        "before": 20,
        "after": 30,
        "unit": "steps/s",
        "machine_ms": [19.6, 17.2],
        "load": [0, 1.2],
    }
    lines = ratios.table({name: row}).splitlines()
    assert lines[2] == f"| {name} | 1.5 | 1.4 x (1.8 x) | 20 | 30 | steps/s | 17 to 20 | 0.0 to 1.2 |"
