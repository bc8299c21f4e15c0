"""Several devices learn what one learns, up to the order of sums, for each kind of state that they divide."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.program import choose_devices
from drivax.tracking.workers import available_cores

CASES = [
    ("bc", "batches"), ("driving_bc", "batches"), ("driving_iql", "batches"), ("driving_td3_bc", "batches"),
    ("driving_cql", "batches"), ("ppo", "two"), ("sac", "two"),
    ("ppo", "four_and_seeds"), ("sac", "four_and_seeds"), ("sac_observations", "two"), ("bc_sac", "two"),
    ("driving_ppo", "two"), ("driving_sac", "two"), ("bc_ppo", "two"), ("ppo", "runs"),
    ("driving_self_ppo", "two"),
]  # fmt: skip
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("bc", "driving_cql", "sac")]
DEVICES = "--xla_force_host_platform_device_count"


def test_cure_names_only_work_that_there_is(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: [0, 1])
    state = {"parameters": np.zeros(3)}
    for batch, words in (
        (None, "an algorithm without environments or batches .* use a multiple of 2 seeds, or fewer devices"),
        (3, "3 steps per batch cannot be .* use a multiple of 2 steps per batch or seeds, or fewer devices"),
    ):
        with pytest.raises(UsageError, match=words):
            choose_devices(2, 1, state, batch)


def test_the_most_devices_that_divide_the_work_are_used(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: [0, 1, 2, 3])
    for batch, seeds, expected in ((6, 1, [0, 1, 2]), (7, 1, [0]), (7, 4, [0, 1, 2, 3]), (None, 1, [0])):
        assert choose_devices(None, seeds, {"parameters": np.zeros(3)}, batch) == expected


def run_on_devices(count, file, *arguments, repository):
    """Run a file of this folder in a process that simulates a number of devices."""
    paths = (str(repository / folder) for folder in ("src", "tests", "tests/learning"))
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, str(repository / "tests" / "learning" / file), *arguments]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.stdout == "same\n", result.stderr


@pytest.mark.parametrize("name", ["functions", "ppo", *SLOW])
def test_devices_exchange_little_and_resume(name, repository):
    run_on_devices(2, "two_devices.py", name, repository=repository)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "extent"), CASES)
def test_devices_and_seeds_learn_the_same_as_one_alone(name, extent, repository):
    run_on_devices(4, "several_devices.py", name, extent, repository=repository)


@pytest.mark.parametrize(
    ("variables", "count"),
    [({}, len(available_cores())), ({"JAX_NUM_CPU_DEVICES": "3"}, 3), ({"XLA_FLAGS": f"{DEVICES}=3"}, 3)],
    ids=["default", "JAX_NUM_CPU_DEVICES", "XLA_FLAGS"],
)
def test_every_core_is_a_device_unless_the_user_sets_their_number(variables, count):
    code = "from drivax.learning.program import use_all_cores as use; use(); import jax; print(jax.device_count())"
    environment = os.environ | {"XLA_FLAGS": ""} | variables | {"PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.check_output([sys.executable, "-c", code], env=environment, text=True) == f"{count}\n"
