"""The account of memory: bytes that are counted by hand, and what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from drivax.errors import UsageError
from drivax.learning import program
from drivax.learning.environment import Environments
from drivax.learning.program import MemoryAccount, account
from drivax.scenario.record import record


@record
class State:
    parameters: jax.Array
    key: jax.Array
    environments: Environments
    learner: dict


@record
class Inner:
    replay: jax.Array


def test_account_covers_all_bytes(monkeypatch):
    monkeypatch.setattr(program, "free_memory", lambda device, share: 8 * 10**8 // share)
    data = {"scenarios": jnp.zeros((5, 7)), "codes": jnp.zeros(9, jnp.int8)}
    state = State(
        parameters=jnp.zeros((10, 3)),
        key=jax.random.key(0),
        environments=Environments(jnp.zeros(4), jnp.zeros(4, bool), {"ego": jnp.zeros((4, 2), jnp.bfloat16)}),
        learner={"inner": Inner(jnp.zeros((100, 4), jnp.int32))},
    )

    def iterate(data, state):
        square = jnp.outer(data["scenarios"].ravel(), data["scenarios"].ravel())
        square = jnp.sort(square, axis=0)  # has to be kept: 35 x 35 numbers
        return replace(state, parameters=state.parameters + square.sum()), jnp.zeros(50) + square[0, 0]

    compiled = jax.jit(iterate, donate_argnums=1).lower(data, state).compile()
    memory = account(data, jnp.zeros(6), state, compiled, jax.devices()[:1])
    assert {name: size for name, size in memory.sizes.items() if name != "program"} == {
        "scenarios": 5 * 7 * 4 + 9, "validation": 24, "replay": 1600, "environments": 16 + 4 + 16,
        "networks and optimiser": 120 + 8,
    }  # fmt: skip
    # Results that take the place of no argument, and the table.
    assert 200 + 35 * 35 * 4 <= memory.sizes["program"] < 10 * 35 * 35 * 4
    assert memory.total == sum(memory.sizes.values())
    # Scenarios and validation scenarios are part of what is in use.
    assert memory.limit == 8 * 10**8 + 5 * 7 * 4 + 9 + 24
    assert memory.text().startswith("memory: ") and "replay 1.6 kB" in memory.text()


def test_training_that_does_not_fit_is_refused_with_a_cure():
    sizes = {"scenarios": 3_000_000_000, "replay": 5_000_000_000, "program": 2}
    fits = MemoryAccount(sizes, 9_000_000_000, "cuda:0")
    fits.check()
    replace(fits, limit=None).check()
    with pytest.raises(UsageError) as refused:
        replace(fits, limit=7_999_999_999).check()
    assert str(refused.value) == (
        "training does not fit; memory: 8.0 GB of 8.0 GB free on cuda:0: scenarios 3.0 GB, replay 5.0 GB, program 2 B; "
        "lower replay.capacity, or set replay.store to state"
    )
