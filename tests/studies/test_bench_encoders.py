"""Counting and timing encoders, from the command line."""

import json
import math

import pytest

from drivax.cli import bench, main
from drivax.errors import UsageError
from drivax.networks.encoders import MlpConfig
from drivax.studies.bench_encoders import EncoderBench, bench_encoders, encoder_sizes
from drivax.tasks.observations import ObservationConfig

TINY = [
    "--only", "[mlp]", "--batches", "[1, 2]", "--repeats", "1", "--observation.agents", "2", "--observation.steps", "1",
    "--observation.road", "0", "--observation.lights", "1", "--observation.route", "2",
]  # fmt: skip


def test_settings_of_the_simulator_are_refused(capsys):
    assert main(["bench", "--encoders", "--batch", "512", "--trust-code", "mine", *TINY]) == 2
    assert "leave out --batch --trust-code" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_counts_and_times(capsys, monkeypatch):
    assert main(["bench", "--encoders", "--json", *TINY]) == 0
    found = json.loads(capsys.readouterr().out)
    (row,), shapes = found["rows"], found["observation"]
    assert (row["encoder"], row["dtype"], row["width"]) == ("mlp", "float32", 256)
    assert shapes["agents_mask"] == [2, 1] and shapes["route_mask"] == [2] and "road" not in shapes
    assert row["parameters"] == (sum(math.prod(shape) for shape in shapes.values()) + 1 + 257) * 256
    assert set(row["forward_us"]) == {"1", "2"}
    assert all(value > 0 for value in (*row["forward_us"].values(), row["gradient_us"]))
    monkeypatch.setattr(bench, "bench_encoders", lambda config: found)
    assert main(["bench", "--encoders", *TINY]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == [
        "encoder", "computes", "in", "parameters", "width", "batch", "1", "batch", "2", "backward"
    ]  # fmt: skip
    assert lines[2].split()[:4] == ["mlp", "float32", f"{row['parameters']:,}", "256"]


@pytest.mark.slow
def test_all_but_variants_are_timed_in_bfloat16_too():
    tiny = ObservationConfig(agents=2, steps=1, road=0, lights=1, route=2)
    config = EncoderBench(("entity small", "wayformer small, early"), (1,), 1, tiny)
    rows = bench_encoders(config)["rows"]
    assert [(row["encoder"], row["dtype"]) for row in rows] == [
        ("entity small", "float32"), ("entity small", "bfloat16"), ("wayformer small, early", "float32")
    ]  # fmt: skip
    assert all(row["gradient_us"] > 0 for row in rows)


def test_sizes_take_no_computation():
    spec = {"ego": (5, 6), "agents": (3, 2), "agents_mask": (3,)}
    found = encoder_sizes(MlpConfig(rows=(4,), hidden=(7,)), spec)
    assert found == {"parameters": (3 * 4 + 4) + (30 + 4) * 7 + 7, "width": 7}


def test_mistakes_are_named():
    with pytest.raises(UsageError, match="unknown encoder 'lq smal'; did you mean 'lq small'"):
        EncoderBench(only=("lq smal",))
    with pytest.raises(UsageError, match="use at least one"):
        EncoderBench(batches=())
