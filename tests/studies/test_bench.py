"""Which batch sizes the table of metric sets shows, and which settings are refused."""

import pytest

from drivax.errors import UsageError
from drivax.studies import bench
from drivax.studies.bench import BenchConfig, metric_rows
from scenes import bank_of, car, straight_road


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
