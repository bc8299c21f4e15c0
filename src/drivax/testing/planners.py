"""Checks of planners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.evaluation.rollout import evaluation_task
from drivax.planners.catalogue import make_planner
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import SimState
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    CLOSE,
    Program,
    check_numbers,
    check_same,
    check_turned,
    compiled,
    expect,
    forms,
    same,
)
from drivax.testing.terms import ANGLE

#: Steps at which the planner starts; step after whose successor the log is changed.
_STARTS, _CHANGES = (12, 20, 28, 36, 45, 52, 60, 70), 45


def check_planner(planner: Planner | str, *, task: Task | None = None, privileged: bool = False) -> None:
    """Check a planner.

    Its actions are finite and have the task's shape; its carry keeps its shape. Actions do not depend on batching,
    repetition, rotation and shift of the world, the order of agents, padding, rows of absent agents, or the log's
    future.

    Args:
        planner: The planner, its name, or its dotted name.
        task: The planner's task; the default task otherwise.
        privileged: Whether it may read the log's future.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    planner = make_planner(planner) if isinstance(planner, str) else planner
    expect(
        isinstance(planner, Planner) and not isinstance(planner, type),
        f"{planner!r} is not a planner",
        "give it name, replays, init and act (planners.planner.Planner)",
    )
    what = f"planner {planner.name!r}"
    simulator, bank = Simulator(evaluation_task(task or Task())), worlds.worlds()
    _check_forms(what, simulator, planner, bank)
    index, step = (part.ravel() for part in np.meshgrid(np.arange(len(bank)), _STARTS, indexing="ij"))
    program = Program(what, _driven(simulator, planner), (None, 0, 0))
    actions = program(bank, index, step)
    check_numbers(what, actions)
    check_numbers(what, program(worlds.without_others(bank), index, step))
    alone = compiled(what, _driven(simulator, planner), bank, jnp.asarray(index[0]), jnp.asarray(step[0]))
    expect(
        same(actions[0], alone, CLOSE),
        f"{what} differs in a batch or is not deterministic",
        "write it for one agent in one scenario, take randomness from the key, and keep no state between calls",
    )

    def check_variant(bank: ScenarioBank, cause: str, cure: str) -> None:
        check_same(what, actions, program(bank, index, step), cause, cure)

    check_variant(worlds.scattered(bank), "the rows of absent agents change", "mask with frame.valid first")
    check_variant(worlds.shuffled(bank), "the order of agents changes", "let no action depend on a slot")
    check_variant(worlds.padded(bank), "empty slots are added", "mask with frame.valid, also before a mean")
    check_turned(what, actions, program(worlds.worlds(ANGLE), index, step))
    if not privileged:
        at = np.full_like(step, _CHANGES)
        expect(
            same(
                program(bank, index, at), program(worlds.other_future(bank, _CHANGES + 1), index, at), CLOSE
            ),
            f"{what} changes with the log's future",
            "read nothing later than context.step, or pass privileged=True",
        )


def _driven(simulator: Simulator, planner: Planner) -> Callable[..., Array]:
    """Return the actions of two consecutive steps."""

    def drive(bank: ScenarioBank, index: Any, step: Any) -> Array:
        state, key = simulator.reset(bank, index, step), jax.random.key(3)
        carry, actions = planner.init(bank, state, key), []
        for _ in range(2):
            action, carry = _act(simulator, planner, bank, state, carry)
            state = simulator.step(bank, state, action)[0]
            actions.append(action)
        return jnp.stack(actions)

    return drive


def _act(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, state: SimState, carry: Any
) -> tuple[Array, Any]:
    situation, seen = simulator.situation(bank, state), simulator.observe(bank, state.context)
    return planner.act(carry, bank, state, situation, seen, jax.random.key(5))


def _check_forms(what: str, simulator: Simulator, planner: Planner, bank: ScenarioBank) -> None:
    """Check the shape of action and carry."""

    def once(bank: ScenarioBank) -> Any:
        state = simulator.reset(bank, 0)
        carry = planner.init(bank, state, jax.random.key(3))
        action, after = _act(simulator, planner, bank, state, carry)
        return (
            state.context.action,
            action,
            jax.tree.map(jnp.asarray, carry),
            jax.tree.map(jnp.asarray, after),
        )

    expected, action, before, after = forms(what, once, bank)
    expect(
        action.shape == expected.shape and action.dtype == expected.dtype,
        f"{what} gives {action.dtype}{list(action.shape)} as an action",
        f"return {expected.dtype}{list(expected.shape)}",
    )
    carried = [
        (jax.tree.structure(carry), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(carry)])
        for carry in (before, after)
    ]
    expect(
        carried[0] == carried[1],
        f"{what} changes the shape of its carry",
        "return from act the same structure, shapes and types as from init",
    )
