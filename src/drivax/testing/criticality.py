"""Checks of criticality methods."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.curation.logged import LoggedScenario, read_log
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.testing import worlds
from drivax.testing.contract import (
    BatchedFunction,
    array_type,
    check_numbers,
    check_rotated,
    check_variants,
    expect,
    instance,
    label,
)


def check_criticality(method: Callable[[ScenarioBank, LoggedScenario], dict[str, Any]] | str) -> None:
    """Check a criticality method or its dotted name; raise :class:`BrokenContract` if it violates a rule.

    It is a pure, hashable function of a bank and the log of an ego. Its result is a dict of components, each with a
    float32 number in [0, 1] for every step. They do not depend on compilation, batching, rotation and shift of the
    world, the order of agents, padding, or rows of absent agents.
    """
    score = instance(method)
    what = f"criticality method {label(score)!r}"
    expect(callable(score), f"{what} cannot be called", "write a function of a bank and a log")
    try:
        hash(score)
    except TypeError:
        expect(False, f"{what} cannot be hashed", "make its dataclass frozen, with tuples instead of lists")

    def components(bank: ScenarioBank, row: Any) -> Any:
        values = score(bank, read_log(bank, row))
        expect(
            isinstance(values, dict) and values, f"{what} gives no dict of components", "name each of them"
        )
        for name, value in values.items():
            array = jnp.asarray(value)
            is_right = array.shape == (bank.steps,) and array.dtype == jnp.float32
            problem = f"component {name!r} of {what} is {array_type(array)}, not float32[{bank.steps}]"
            expect(is_right, problem, "return a number for every step of the log")
        return values

    program, bank = BatchedFunction(what, components, (None, 0)), worlds.worlds()
    rows = jnp.arange(len(bank))
    result = program.check_pure(bank, rows)
    check_numbers(what, result)
    for name, value in result.items():
        is_inside = (np.asarray(value) >= 0.0) & (np.asarray(value) <= 1.0)
        problem = f"component {name!r} of {what} is outside [0, 1] at {int((~is_inside).sum())} steps"
        expect(is_inside.all(), problem, "scale and clip it")
    check_variants(what, result, worlds.BANK_VARIANTS, lambda variant: program(variant(bank), rows))
    check_rotated(what, *jax.tree.map(np.ravel, (result, program(worlds.worlds(worlds.ANGLE), rows))))
