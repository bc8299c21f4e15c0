"""Checks of planners and traffic models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from drivax.evaluation.rollout import evaluation_task
from drivax.planners.catalogue import make_planner
from drivax.planners.planner import Planner
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import alone, logged_history
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import AgentContext, SimState, Traffic
from drivax.tasks.observations import View
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    CLOSE,
    Program,
    check_numbers,
    check_same,
    check_turned,
    check_variants,
    expect,
    form,
    forms,
    layout,
    program,
    same,
)
from drivax.testing.worlds import ANGLE

#: Steps at which the planner starts; step after whose successor the log is changed.
_STARTS, _CHANGES = (12, 20, 28, 36, 45, 52, 60, 70), 45
#: First step and number of steps of a traffic model.
_START, _STEPS = 20, 12
#: Largest movement in one step, m.
_JUMP_M = 8.0
#: Largest state of one environment with reactive traffic, bytes.
_STATE_BYTES = 16_000


def check_planner(planner: Planner | str, *, task: Task | None = None, privileged: bool = False) -> None:
    """Check a planner; raise :class:`BrokenContract` if it breaks a rule.

    Its actions are finite and have the task's shape; its carry keeps its shape. Actions do not depend on batching,
    repetition, rotation and shift of the world, the order of agents, padding, rows of absent agents, or the log's
    future.

    Args:
        planner: The planner, its name, or its dotted name.
        task: The planner's task; the default task otherwise.
        privileged: Whether it may read the log's future.
    """
    planner = make_planner(planner) if isinstance(planner, str) else planner
    valid = isinstance(planner, Planner) and not isinstance(planner, type)
    cure = "give it name, replays, init and act (planners.planner.Planner)"
    expect(valid, f"{planner!r} is not a planner", cure)
    what = f"planner {planner.name!r}"
    simulator, bank = Simulator(evaluation_task(task or Task())), worlds.worlds()
    _check_layout(what, simulator, planner, bank)
    index, step = (axis.ravel() for axis in np.meshgrid(np.arange(len(bank)), _STARTS, indexing="ij"))
    actions_of = _driven(simulator, planner)
    run = Program(what, actions_of, (None, 0, 0))
    actions = run(bank, index, step)
    check_numbers(what, actions)
    check_numbers(what, run(worlds.without_others(bank), index, step))
    single = program(what, actions_of)(bank, jnp.asarray(index[0]), jnp.asarray(step[0]))
    cure = "write it for one agent in one scenario, take randomness from the key, and keep no state between calls"
    expect(same(actions[0], single, CLOSE), f"{what} differs in a batch or is not deterministic", cure)
    check_variants(what, actions, worlds.BANK_VARIANTS, lambda change: run(change(bank), index, step))
    check_turned(what, actions, run(worlds.worlds(ANGLE), index, step))
    if not privileged:
        at = np.full_like(step, _CHANGES)
        now, later = (run(world, index, at) for world in (bank, worlds.other_future(bank, _CHANGES + 1)))
        cure = "read nothing later than context.step, or pass privileged=True"
        check_same(what, now, later, "the log's future changes", cure)


def _driven(simulator: Simulator, planner: Planner) -> Callable[..., Array]:
    """Return the actions of two consecutive steps."""

    def drive(bank: ScenarioBank, index: Any, step: Any) -> Array:
        state = simulator.reset(bank, index, step)
        carry, actions = planner.init(bank, state, jax.random.key(3)), []
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


def _check_layout(what: str, simulator: Simulator, planner: Planner, bank: ScenarioBank) -> None:
    """Check shapes and types of action and carry."""

    def once(bank: ScenarioBank) -> Any:
        state = simulator.reset(bank, 0)
        before = planner.init(bank, state, jax.random.key(3))
        action, after = _act(simulator, planner, bank, state, before)
        return state.context.action, action, jax.tree.map(jnp.asarray, (before, after))

    expected, action, (before, after) = forms(what, once, bank)
    problem = f"{what} gives {form(action)} as an action"
    expect(form(action) == form(expected), problem, f"return {form(expected)}")
    cure = "return from act the same structure, shapes and types as from init"
    expect(layout(before) == layout(after), f"{what} changes the shape of its carry", cure)


@record
class _Seen:
    """Rows of a model over some steps: now, the same one step later, and the ego frame."""

    rows: Any
    remembered: Any
    view: View


def check_traffic(traffic: Traffic | str) -> None:
    """Check a traffic model, its name or dotted name; raise :class:`BrokenContract` if it breaks a rule.

    Its state keeps its shape and is small. Its rows are like ``bank.agents``: finite, unit directions, valid 0 or 1.
    Past rows are repeated unchanged; no agent jumps. It does not depend on compilation, batching, rotation and shift
    of the world, the order of agents, padding, or rows of absent agents.
    """
    traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
    what = f"traffic {traffic.name!r}"
    bank = prepare_bank(traffic, worlds.worlds())
    _check_state(what, traffic, bank)
    index, run = jnp.arange(len(bank)), Program(what, _moved(traffic), (None, 0))
    seen: _Seen = run.check_pure(bank, index)
    _check_rows(what, seen)

    def rows_of(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        return run(prepare_bank(traffic, change(worlds.worlds())), index).rows

    slots = seen.rows.shape[2]

    def valid_rows(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        """Return valid rows in the slots of the world itself."""
        rows = rows_of(change)[:, :, :slots]
        rows = np.where(rows[..., AgentColumn.VALID :] > 0, rows, 0.0)
        return rows[:, :, np.argsort(worlds.order_of(slots))] if change is worlds.shuffled else rows

    check_numbers(what, rows_of(worlds.without_others))
    known = np.where(seen.rows[..., AgentColumn.VALID :] > 0, seen.rows, 0.0)
    check_variants(what, known, worlds.BANK_VARIANTS, valid_rows)
    turned = run(prepare_bank(traffic, worlds.worlds(ANGLE)), index)
    check_turned(what, _from_ego(seen), _from_ego(turned))


def _moved(traffic: Traffic) -> Callable[[ScenarioBank, Any], _Seen]:
    """Return rows over some steps: ego replays its log, the model moves all others."""
    simulator = Simulator(Task(), traffic)

    def drive(bank: ScenarioBank, index: Any) -> _Seen:
        def step(context: AgentContext, _: None) -> tuple[AgentContext, _Seen]:
            frame = simulator.frame(bank, context, alone(context), 0)
            moved = replace(
                context,
                step=context.step + 1,
                history=logged_history(bank, index, context.step + 1, 0),
                traffic=traffic.advance(bank, context, frame),
            )
            rows, remembered = traffic.agents(bank, context, 0), traffic.agents(bank, moved, 1)
            return moved, _Seen(rows, remembered, View.of(context))

        return jax.lax.scan(step, simulator.context(bank, index, _START), None, _STEPS)[1]

    return drive


def _check_state(what: str, traffic: Traffic, bank: ScenarioBank) -> None:
    simulator = Simulator(Task(), traffic)

    shape = bank.agents.shape[2:]
    rows = jax.eval_shape(lambda bank: traffic.agents(bank, simulator.context(bank, 0, _START), 0), bank)
    problem = f"{what} gives {form(rows)} as the rows of {shape[0]} agents"
    cure = "return float32 rows like bank.agents[index, step]"
    expect(rows.shape == shape and rows.dtype == jnp.float32, problem, cure)

    def states(bank: ScenarioBank) -> tuple[Any, Any]:
        context = simulator.context(bank, 0, _START)
        frame = simulator.frame(bank, context, alone(context), 0)
        return context.traffic, traffic.advance(bank, context, frame)

    first, second = jax.eval_shape(states, bank)
    cure = "return from advance the same structure, shapes and types as from start"
    expect(layout(first) == layout(second), f"{what} changes the shape of its state in a step", cure)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(first))
    cure = f"keep at most {_STATE_BYTES}; move what depends on the bank only to prepare(bank)"
    expect(size <= _STATE_BYTES, f"{what} carries {size} bytes per environment", cure)


def _check_rows(what: str, seen: _Seen) -> None:
    check_numbers(what, seen.rows)
    rows, remembered = seen.rows[:, :, 1:], seen.remembered[:, :, 1:]
    valid = rows[..., AgentColumn.VALID]
    expect(np.isin(valid, (0.0, 1.0)).all(), f"{what} has fractional valid", "let valid be 0 or 1")
    there = valid > 0
    length = np.hypot(rows[..., 3], rows[..., 4])
    unit = np.allclose(length[there], 1.0, atol=1e-3)
    problem = f"{what} has directions of length {length[there].min():.3g} to {length[there].max():.3g}"
    expect(unit, problem, "columns 3 and 4 are cosine and sine of the heading")
    kept = (remembered[..., AgentColumn.VALID] == valid).all()
    kept = kept and np.allclose(remembered[there], rows[there], rtol=CLOSE, atol=1e-2)
    cure = "let agents(bank, context, back) return all agents 'back' steps ago"
    expect(kept, f"{what} changes past rows", cure)
    both = there[:, 1:] & there[:, :-1]
    jump = np.linalg.norm(np.diff(rows[..., :2], axis=1), axis=-1)[both]
    problem = f"{what} moves an agent by {jump.max(initial=0.0):.1f} m in a step"
    cure = "a step lasts 0.1 s; a slot is invalid before another agent takes it"
    expect((jump <= _JUMP_M).all(), problem, cure)


def _from_ego(seen: _Seen) -> Any:
    """Return valid rows in the ego frame, one moment per row."""
    rows = np.asarray(seen.rows)[:, :, 1:]
    cos, sin = (np.asarray(part)[..., None] for part in (seen.view.cos, seen.view.sin))

    def ahead(vector: Any) -> Any:
        x, y = vector[..., 0], vector[..., 1]
        return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)

    offset, valid = rows[..., :2] - np.asarray(seen.view.xy)[:, :, None], rows[..., AgentColumn.VALID :]
    vectors = (offset, rows[..., AgentColumn.HEADING], rows[..., AgentColumn.VELOCITY])
    result = np.concatenate([*map(ahead, vectors), valid], axis=-1) * valid
    return result.reshape(-1, *result.shape[2:])
