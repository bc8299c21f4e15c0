"""Several devices learn what one learns, up to the order of sums, for each kind of state that they divide."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.program import _as_bits, _from_bits, choose_devices

CASES = [
    ("bc", "batches"), ("driving_bc", "batches"), ("driving_iql", "batches"), ("driving_td3_bc", "batches"),
    ("driving_cql", "batches"), ("ppo", "two"), ("sac", "two"),
    ("ppo", "four_and_seeds"), ("sac", "four_and_seeds"), ("sac_observations", "two"), ("bc_sac", "two"),
    ("driving_ppo", "two"), ("driving_sac", "two"), ("bc_ppo", "two"), ("ppo", "runs"),
    ("driving_self_ppo", "two"),
]  # fmt: skip


def test_cure_names_only_work_that_there_is(monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: [0, 1])
    state = {"parameters": np.zeros(3)}
    for batch, words in (
        (None, "an algorithm without environments or batches .* use a multiple of 2 seeds, or fewer devices"),
        (3, "3 steps per batch cannot be .* use a multiple of 2 steps per batch or seeds, or fewer devices"),
    ):
        with pytest.raises(UsageError, match=words):
            choose_devices(2, 1, state, batch)


@pytest.mark.parametrize(
    "values",
    [
        np.float32([np.nan, -0.0, np.inf, 1e-45, -1.5]),
        np.float16([np.nan, -0.0, -np.inf, 6e-8]),
        np.uint32([0, 2**31, 2**32 - 1]),
        np.int32([-1, 2**31 - 1, -(2**31)]),
        np.array([True, False]),
    ],
    ids=lambda values: str(values.dtype),
)
def test_devices_exchange_every_bit(values):
    bits = _as_bits(jnp.asarray(values))
    assert bits.dtype == np.int32
    result = np.asarray(_from_bits(bits + jnp.zeros_like(bits), values.dtype))
    assert result.dtype == values.dtype and result.tobytes() == values.tobytes()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "extent"), CASES)
def test_devices_and_seeds_learn_the_same_as_one_alone(name, extent, repository, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"] + " --xla_force_host_platform_device_count=4")
    folders = ("src", "tests", "tests/learning")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(repository / folder) for folder in folders))
    command = [sys.executable, str(repository / "tests" / "learning" / "several_devices.py"), name, extent]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.stdout == "same\n", result.stderr
