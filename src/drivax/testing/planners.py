"""Checks of planners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.evaluation.rollout import judging
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

#: Steps at which the planner takes over, and the one after whose successor another story is told.
_LOOKS, _FORGETS = (12, 20, 28, 36, 45, 52, 60, 70), 45


def check_planner(planner: Planner | str, *, task: Task | None = None, privileged: bool = False) -> None:
    """Whether a planner keeps to the rules.

    Its actions are finite and have the size of the task's; what it carries keeps its form; it does the same batched or
    alone and every time; and its actions do not change with the turn and place of the world, the order of the agents,
    padding, what rows hold where nobody is, or what the log holds of the future.

    Args:
        planner: The planner, its name, or its dotted name.
        task: What it was made for; the default one otherwise.
        privileged: It may look at the log's future.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    planner = make_planner(planner) if isinstance(planner, str) else planner
    expect(
        isinstance(planner, Planner) and not isinstance(planner, type),
        f"{planner!r} is no planner",
        "give it name, replays, init and act (planners.planner.Planner)",
    )
    what = f"planner {planner.name!r}"
    simulator, bank = Simulator(judging(task or Task())), worlds.worlds()
    _check_forms(what, simulator, planner, bank)
    index, step = (part.ravel() for part in np.meshgrid(np.arange(len(bank)), _LOOKS, indexing="ij"))
    program = Program(what, _driven(simulator, planner), (None, 0, 0))
    asked = program(bank, index, step)
    check_numbers(what, asked)
    check_numbers(what, program(worlds.deserted(bank), index, step))
    alone = compiled(what, _driven(simulator, planner), bank, jnp.asarray(index[0]), jnp.asarray(step[0]))
    expect(
        same(asked[0], alone, CLOSE),
        f"{what} acts otherwise in a batch than alone, or every time",
        "write it for one agent in one scenario, take randomness from the key, and keep nothing between calls",
    )

    def told(bank: ScenarioBank, cause: str, cure: str) -> None:
        check_same(what, asked, program(bank, index, step), cause, cure)

    told(worlds.littered(bank), "rows hold something else where nobody is", "mask with frame.valid first")
    told(worlds.shuffled(bank), "the agents stand in another order", "let nothing follow from a slot")
    told(worlds.padded(bank), "there are more empty slots", "mask with frame.valid, also before a mean")
    check_turned(what, asked, program(worlds.worlds(ANGLE), index, step))
    if not privileged:
        at = np.full_like(step, _FORGETS)
        expect(
            same(program(bank, index, at), program(worlds.forgotten(bank, _FORGETS + 1), index, at), CLOSE),
            f"{what} changes when the log goes on in another way",
            "look at nothing later than context.step, or say privileged=True",
        )


def _driven(simulator: Simulator, planner: Planner) -> Callable[..., Array]:
    """The actions of two steps on end."""

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
    """Whether the action has its size, and the carry keeps its form."""

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

    wanted, action, before, after = forms(what, once, bank)
    expect(
        action.shape == wanted.shape and action.dtype == wanted.dtype,
        f"{what} gives {action.dtype}{list(action.shape)} as an action",
        f"give {wanted.dtype}{list(wanted.shape)}",
    )
    carried = [
        (jax.tree.structure(carry), [(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(carry)])
        for carry in (before, after)
    ]
    expect(
        carried[0] == carried[1],
        f"{what} changes the form of what it carries",
        "return from act what init returned: the same structure, shapes and types",
    )
