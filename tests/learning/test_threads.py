"""The thread pool of a training of several seeds."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os
from drivax.cli import train
from drivax.learning.program import widen_pool
os.cpu_count = lambda: 64
os.sched_getaffinity = lambda _: {0, 1}
widen_pool()
import jax
jax.numpy.ones(3).block_until_ready()
names = [open(f"/proc/self/task/{task}/comm").read() for task in os.listdir("/proc/self/task")]
print(os.environ["NPROC"], sum("XLA" in name for name in names))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads as Linux lists them")
@pytest.mark.parametrize("requested", [None, "3"])
def test_thread_pool_has_eight_threads_by_default(requested):
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    environment |= {"NPROC": requested} if requested else {}
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    )
    pool_size, threads = map(int, result.stdout.split())
    assert pool_size == int(requested or 8) and threads >= pool_size
