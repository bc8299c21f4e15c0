"""Counting and timing encoders, from the command line."""

import json

import pytest

from drivax.cli import bench, main
from drivax.errors import UsageError
from drivax.networks.encoders import MlpConfig
from drivax.studies.bench_encoders import EncoderBench, encoder_sizes

TINY = [
    "--only", "[entity small]", "--batches", "[1, 2]", "--repeats", "1", "--observation.agents", "2",
    "--observation.steps", "1", "--observation.road", "0", "--observation.lights", "1", "--observation.route", "2",
]  # fmt: skip


def test_the_command_counts_and_times(capsys, monkeypatch):
    assert main(["bench", "--encoders", "--json", *TINY]) == 0
    found = json.loads(capsys.readouterr().out)
    rows, shapes = found["rows"], found["observation"]
    assert [(row["encoder"], row["dtype"]) for row in rows] == [
        ("entity small", "float32"), ("entity small", "bfloat16")
    ]  # fmt: skip
    # Numbers in a row of each group: with its times side by side, and of a series which of them are there.
    numbers = {
        "ego": shapes["ego"][0] * (shapes["ego"][1] + 1), "ego_static": shapes["ego_static"][0],
        "agents": shapes["agents"][1] * (shapes["agents"][2] + 1), "lights": shapes["lights"][1],
        "route": shapes["route"][1],
    }  # fmt: skip
    wanted = sum((one + 1) * 32 for one in numbers.values()) + 4 * 32 * 32 + 2 * 32
    for row in rows:
        assert row["parameters"] == wanted and row["width"] == 4 * 32
        assert set(row["forward_us"]) == {"1", "2"}
        assert all(value > 0 for value in (*row["forward_us"].values(), row["gradient_us"]))
    monkeypatch.setattr(bench, "bench_encoders", lambda config: found)
    assert main(["bench", "--encoders", *TINY]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == [
        "encoder", "computes", "in", "parameters", "width", "batch", "1", "batch", "2", "backward"
    ]  # fmt: skip
    assert lines[2].split()[:5] == ["entity", "small", "float32", f"{wanted:,}", "128"]


def test_sizes_take_no_computation():
    spec = {"ego": (5, 6), "agents": (3, 2), "agents_mask": (3,)}
    found = encoder_sizes(MlpConfig(rows=(4,), hidden=(7,)), spec)
    assert found == {"parameters": (3 * 4 + 4) + (30 + 4) * 7 + 7, "width": 7}


def test_mistakes_are_named():
    with pytest.raises(UsageError, match="there is no encoder 'lq smal'; did you mean 'lq small'"):
        EncoderBench(only=("lq smal",))
    with pytest.raises(UsageError, match="use at least one"):
        EncoderBench(batches=())
