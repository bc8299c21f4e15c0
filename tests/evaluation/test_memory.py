"""Evaluation batch size from free memory, and the error when memory runs out."""

import re

import jax
import jax.numpy as jnp
import pytest

from drivax.errors import DrivaxError
from drivax.evaluation.memory import (
    MOST,
    _group_limits,
    free_memory,
    memory_of,
    report_out_of_memory,
    scenarios_at_a_time,
)


def test_half_of_free_memory_holds_two_copies_and_the_program():
    # Half of 2 GB: 16 x 8 MB for the program leave 872 MB, for two copies of 436 scenarios of 1 MB.
    assert scenarios_at_a_time(1_000_000, 16, 2_000_000_000) == 436
    assert scenarios_at_a_time(1_000_000, 16, 100_000_000) == 16, "never fewer than a program call runs"
    assert scenarios_at_a_time(1_000, 16, 10**12) == scenarios_at_a_time(1_000, 16, None) == MOST


def test_this_machine_has_free_memory():
    device = jax.devices()[0]
    assert 10**7 < free_memory(device) <= memory_of(device)
    assert free_memory(device, 10**6) < 10**-5 * memory_of(device)


def test_free_memory_of_a_kernel_that_does_not_tell_it(tmp_path, monkeypatch):
    (tmp_path / "meminfo").write_text("MemTotal: 5 kB\n")
    monkeypatch.setattr("drivax.evaluation.memory._MEMORY_INFO", tmp_path / "meminfo")
    assert free_memory(jax.devices()[0]) > 10**7


def test_every_control_group_of_the_process_counts(tmp_path):
    groups, ours = tmp_path / "cgroup", tmp_path / "self"
    job = groups / "batch" / "job-7"
    job.mkdir(parents=True)
    ours.write_text("0::/batch/job-7\n")
    assert _group_limits(groups, ours) == [], "no group has a limit"
    (groups / "batch" / "memory.max").write_text("max\n")
    (groups / "batch" / "memory.current").write_text("500\n")
    (job / "memory.max").write_text("1000\n")
    (job / "memory.current").write_text("400\n")
    assert _group_limits(groups, ours) == [(1000, 400)]
    # The page cache does not count as used.
    (job / "memory.stat").write_text("anon 290\nactive_file 30\ninactive_file 80\n")
    assert _group_limits(groups, ours) == [(1000, 290)]
    # Version 1 has a folder per controller; in a container the root is the group itself.
    ours.write_text("4:memory:/elsewhere\n3:cpu:/\n0::/\n")
    (groups / "memory").mkdir()
    (groups / "memory" / "memory.limit_in_bytes").write_text("2000\n")
    (groups / "memory" / "memory.usage_in_bytes").write_text("1\n")
    assert _group_limits(groups, ours) == [(2000, 1)]
    assert _group_limits(groups, tmp_path / "none") == []


def test_out_of_memory_is_one_line_with_the_cure():
    """A program that needs 4 TB, and NumPy's error."""

    @jax.jit
    def greedy(x):
        return jnp.cumsum(jnp.arange(2**40, dtype=jnp.float32) * x)[-1]

    def starve():
        raise MemoryError

    # XLA may need several copies of the 4.4 TB at once.
    wasteful = {r": no room for an array of \d\.\d TB": lambda: greedy(1.0).block_until_ready(), "": starve}
    for array, waste in wasteful.items():
        out_of_memory = report_out_of_memory("with 9 scenarios loaded", "load fewer")
        with pytest.raises(DrivaxError) as raised, out_of_memory:
            waste()
        line = f"out of memory with 9 scenarios loaded{array}; load fewer"
        assert re.fullmatch(line, str(raised.value))
    with pytest.raises(ValueError, match="else"), report_out_of_memory("", ""):
        raise ValueError("something else")
