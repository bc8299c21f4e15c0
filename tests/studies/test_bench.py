"""Batch sizes in the table of metric sets, refused settings, and counting and timing of encoders."""

import json
import math

import pytest

from drivax import cli
from drivax.errors import UsageError
from drivax.networks.encoders import MlpConfig
from drivax.studies import bench
from drivax.studies.bench import BenchConfig, EncoderBench, bench_encoders, encoder_sizes, metric_rows
from drivax.tasks.observations import ObservationConfig
from scenes import bank_of, car, straight_road

TINY = [
    "--only", "[mlp]", "--batches", "[1, 2]", "--repeats", "1", "--observation.agents", "2", "--observation.steps", "1",
    "--observation.road", "0", "--observation.lights", "1", "--observation.route", "2",
]  # fmt: skip


def test_the_best_batch_is_the_best_of_all():
    """For one set the best is a size of the table, for the others a larger one, which then has a row of its own."""
    speeds = {
        ("none", 32): 100.0, ("none", 128): 300.0, ("none", 256): 200.0, ("none", 1024): 150.0,
        ("training", 32): 90.0, ("training", 128): 200.0, ("training", 256): 190.0, ("training", 1024): 250.4,
        ("full", 32): 50.0, ("full", 128): 40.0, ("full", 256): 60.0, ("full", 1024): 55.0,
    }  # fmt: skip
    names = ("metrics", "batch", "best", "steps_per_second", "relative")
    assert [tuple(row[name] for name in names) for row in metric_rows(speeds)] == [
        ("none", 32, False, 100, 2.0), ("none", 128, True, 300, 6.0),
        ("training", 32, False, 90, 1.8), ("training", 128, False, 200, 4.0), ("training", 1024, True, 250, 5.01),
        ("full", 32, False, 50, 1.0), ("full", 128, False, 40, 0.8), ("full", 256, True, 60, 1.2),
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["batch", "steps", "repeats"])
def test_numbers_below_one_are_refused(name):
    with pytest.raises(UsageError, match=f"{name} is 0; use 1 or more"):
        BenchConfig(**{name: 0})


def test_metric_sets_need_a_number_of_devices_that_divides_their_batches(monkeypatch):
    monkeypatch.setattr(bench.jax, "device_count", lambda: 12)
    with pytest.raises(
        UsageError, match="batches of 32 cannot be divided among 12 devices; use a number of cores"
    ):
        bench.bench_metrics(bank_of(straight_road([car()])))


def test_settings_of_the_simulator_are_refused(capsys):
    assert cli.main(["bench", "--encoders", "--batch", "512", "--trust-code", "mine", *TINY]) == 2
    assert "leave out --batch --trust-code" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_counts_and_times(capsys, monkeypatch):
    assert cli.main(["bench", "--encoders", "--json", *TINY]) == 0
    found = json.loads(capsys.readouterr().out)
    (row,), shapes = found["rows"], found["observation"]
    assert (row["encoder"], row["dtype"], row["width"]) == ("mlp", "float32", 256)
    assert shapes["agents_mask"] == [2, 1] and shapes["route_mask"] == [2] and "road" not in shapes
    assert row["parameters"] == (sum(math.prod(shape) for shape in shapes.values()) + 1 + 257) * 256
    assert set(row["forward_us"]) == {"1", "2"}
    assert all(value > 0 for value in (*row["forward_us"].values(), row["gradient_us"]))
    monkeypatch.setattr(cli.bench, "bench_encoders", lambda config: found)
    assert cli.main(["bench", "--encoders", *TINY]) == 0
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
