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
    TOLERANCE,
    BatchedFunction,
    are_same,
    array_type,
    check_numbers,
    check_rotated,
    check_same,
    check_variants,
    expect,
    layout,
    program,
    result_shapes,
)
from drivax.testing.worlds import ANGLE

#: Start steps of the planner.
_STARTS = (12, 20, 28, 36, 45, 52, 60, 70)
#: Start step of the check that changes the log after the second action.
_CHANGE_START = 45
#: Start step and number of steps of a traffic model.
_START, _STEPS = 20, 12
#: Largest movement in one step, m.
_MAX_STEP_M = 8.0
#: Largest traffic state of one environment, bytes.
_MAX_STATE_BYTES = 16_000


def check_planner(planner: Planner | str, *, task: Task | None = None, privileged: bool = False) -> None:
    """Check a planner; raise :class:`BrokenContract` if it violates a rule.

    Its actions are finite and have the task's shape; its carry keeps its shape. Actions do not depend on batching,
    repetition, rotation and shift of the world, the order of agents, padding, rows of absent agents, or (unless
    privileged) the log's future.

    Args:
        planner: The planner, its name, or its dotted name.
        task: Task of the planner; by default the default task.
        privileged: Whether the planner may read the log's future.
    """
    planner = make_planner(planner) if isinstance(planner, str) else planner
    valid = isinstance(planner, Planner) and not isinstance(planner, type)
    cure = "give it name, replays, init and act (drivax.planners.Planner)"
    expect(valid, f"{planner!r} is not a planner", cure)
    what = f"planner {planner.name!r}"
    simulator, bank = Simulator(evaluation_task(task or Task())), worlds.worlds()
    _check_layout(what, simulator, planner, bank)
    index, step = (axis.ravel() for axis in np.meshgrid(np.arange(len(bank)), _STARTS, indexing="ij"))
    act = _two_actions(simulator, planner)
    run = BatchedFunction(what, act, (None, 0, 0))
    actions = run(bank, index, step)
    check_numbers(what, actions)
    check_numbers(what, run(worlds.without_others(bank), index, step))
    result = program(what, act)(bank, jnp.asarray(index[0]), jnp.asarray(step[0]))
    cure = "write it for one agent in one scenario, take randomness from the key, and keep no state between calls"
    expect(
        are_same(actions[0], result, TOLERANCE), f"{what} differs in a batch or is not deterministic", cure
    )
    check_variants(what, actions, worlds.BANK_VARIANTS, lambda change: run(change(bank), index, step))
    check_rotated(what, actions, run(worlds.worlds(ANGLE), index, step))
    if not privileged:
        start, changed_bank = np.full_like(step, _CHANGE_START), worlds.change_future(bank, _CHANGE_START + 1)
        cure = "read nothing later than context.step, or pass privileged=True"
        cause = "the log's future changes"
        check_same(what, run(bank, index, start), run(changed_bank, index, start), cause, cure)


def _two_actions(simulator: Simulator, planner: Planner) -> Callable[..., Array]:
    """Return a function that computes the actions of two consecutive steps."""

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
) -> tuple[Any, Any]:
    """Return the action and the carry, which are the user's and may be anything."""
    situation, observation = simulator.situation(bank, state), simulator.observe(bank, state.context)
    return planner.act(carry, bank, state, situation, observation, jax.random.key(5))


def _check_layout(what: str, simulator: Simulator, planner: Planner, bank: ScenarioBank) -> None:
    """Check shapes and types of action and carry."""

    def act_once(bank: ScenarioBank) -> Any:
        state = simulator.reset(bank, 0)
        before = planner.init(bank, state, jax.random.key(3))
        action, after = _act(simulator, planner, bank, state, before)
        return state.context.action, action, jax.tree.map(jnp.asarray, (before, after))

    expected, action, (before, after) = result_shapes(what, act_once, bank)
    problem = f"{what} gives {', '.join(layout(action)[1])} as an action"
    expect(layout(action) == layout(expected), problem, f"return {array_type(expected)}")
    cure = "return from act the same structure, shapes and types as from init"
    expect(layout(before) == layout(after), f"{what} changes the shape of its carry", cure)


@record
class _Rollout:
    """Rows of a traffic model over several steps, the same rows read one step later, and the ego frame."""

    rows: Any
    past_rows: Any
    view: View


def check_traffic(traffic: Traffic | str) -> None:
    """Check a traffic model, its name or dotted name; raise :class:`BrokenContract` if it violates a rule.

    Its state keeps its shape and is small. Its rows are like ``bank.agents``: finite, with unit directions, valid 0 or
    1. Past rows do not change, and no agent jumps. Results do not depend on compilation, batching, rotation and shift
    of the world, the order of agents, padding, or rows of absent agents.
    """
    traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
    valid = isinstance(traffic, Traffic) and not isinstance(traffic, type)
    cure = "give it name, start, advance and agents (simulator.types.Traffic)"
    expect(valid, f"{traffic!r} is not a traffic model", cure)
    what = f"traffic {traffic.name!r}"
    bank = prepare_bank(traffic, worlds.worlds())
    _check_state(what, traffic, bank)
    index, run = jnp.arange(len(bank)), BatchedFunction(what, _roll_out(traffic), (None, 0))
    rollout: _Rollout = run.check_pure(bank, index)
    _check_rows(what, rollout)

    def rows_of(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        return run(prepare_bank(traffic, change(worlds.worlds())), index).rows

    slots = rollout.rows.shape[2]

    def valid_rows(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        """Return the valid rows of a variant, in the original order."""
        rows = rows_of(change)[:, :, :slots]
        rows = np.where(rows[..., AgentColumn.VALID :] > 0, rows, 0.0)
        return rows[:, :, np.argsort(worlds.order_of(slots))] if change is worlds.permute_agents else rows

    check_numbers(what, rows_of(worlds.without_others))
    expected = np.where(rollout.rows[..., AgentColumn.VALID :] > 0, rollout.rows, 0.0)
    check_variants(what, expected, worlds.BANK_VARIANTS, valid_rows)
    rotated = run(prepare_bank(traffic, worlds.worlds(ANGLE)), index)
    check_rotated(what, _in_ego_frame(rollout), _in_ego_frame(rotated))


def _roll_out(traffic: Traffic) -> Callable[[ScenarioBank, Any], _Rollout]:
    """Return a function that computes rows over several steps; ego replays its log, the model moves all others."""
    simulator = Simulator(Task(), traffic)

    def drive(bank: ScenarioBank, index: Any) -> _Rollout:
        def step(context: AgentContext, _: None) -> tuple[AgentContext, _Rollout]:
            frame = simulator.frame(bank, context, alone(context), 0)
            next_context = replace(
                context,
                step=context.step + 1,
                history=logged_history(bank, index, context.step + 1, 0),
                traffic=traffic.advance(bank, context, frame),
            )
            rows, past_rows = traffic.agents(bank, context, 0), traffic.agents(bank, next_context, 1)
            return next_context, _Rollout(rows, past_rows, View.of(context))

        return jax.lax.scan(step, simulator.context(bank, index, _START), None, _STEPS)[1]

    return drive


def _check_state(what: str, traffic: Traffic, bank: ScenarioBank) -> None:
    simulator, shape = Simulator(Task(), traffic), bank.agents.shape[2:]
    rows = jax.eval_shape(lambda bank: traffic.agents(bank, simulator.context(bank, 0, _START), 0), bank)
    problem = f"{what} gives {', '.join(layout(rows)[1])} as the rows of {shape[0]} agents"
    cure = "return float32 rows like bank.agents[index, step]"
    expect(layout(rows) == layout(jax.ShapeDtypeStruct(shape, jnp.float32)), problem, cure)

    def states(bank: ScenarioBank) -> tuple[Any, Any]:
        context = simulator.context(bank, 0, _START)
        frame = simulator.frame(bank, context, alone(context), 0)
        return context.traffic, traffic.advance(bank, context, frame)

    state, next_state = jax.eval_shape(states, bank)
    cure = "return from advance the same structure, shapes and types as from start"
    expect(layout(state) == layout(next_state), f"{what} changes the shape of its state in a step", cure)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    cure = f"keep at most {_MAX_STATE_BYTES}; move data that depends only on the bank to prepare(bank)"
    expect(size <= _MAX_STATE_BYTES, f"{what} carries {size} bytes per environment", cure)


def _check_rows(what: str, rollout: _Rollout) -> None:
    check_numbers(what, rollout.rows)
    rows, past_rows = rollout.rows[:, :, 1:], rollout.past_rows[:, :, 1:]
    valid = rows[..., AgentColumn.VALID]
    expect(np.isin(valid, (0.0, 1.0)).all(), f"{what} has fractional valid", "let valid be 0 or 1")
    present = valid > 0
    lengths = np.hypot(rows[..., AgentColumn.COS], rows[..., AgentColumn.SIN])[present]
    low, high = lengths.min(initial=np.inf), lengths.max(initial=0.0)
    problem = f"{what} has directions of length {low:.3g} to {high:.3g}"
    is_unit = np.allclose(lengths, 1.0, atol=1e-3)
    expect(is_unit, problem, "columns 3 and 4 are cosine and sine of the heading")
    is_unchanged = (past_rows[..., AgentColumn.VALID] == valid).all()
    is_unchanged = is_unchanged and np.allclose(past_rows[present], rows[present], rtol=TOLERANCE, atol=1e-2)
    cure = "let agents(bank, context, back) return all agents 'back' steps ago"
    expect(is_unchanged, f"{what} changes past rows", cure)
    stays = present[:, 1:] & present[:, :-1]
    moved_m = np.linalg.norm(np.diff(rows[..., :2], axis=1), axis=-1)[stays]
    problem = f"{what} moves an agent by {moved_m.max(initial=0.0):.1f} m in a step"
    cure = "a step lasts 0.1 s; a slot is invalid before another agent takes it"
    expect((moved_m <= _MAX_STEP_M).all(), problem, cure)


def _in_ego_frame(rollout: _Rollout) -> Any:
    """Return the rows of the others in the ego frame, zero where invalid; the first axis is the moment."""
    rows = np.asarray(rollout.rows)[:, :, 1:]
    cos, sin = np.asarray(rollout.view.cos)[..., None], np.asarray(rollout.view.sin)[..., None]

    def rotate(vector: Any) -> Any:
        x, y = vector[..., 0], vector[..., 1]
        return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)

    offset, valid = rows[..., :2] - np.asarray(rollout.view.xy)[:, :, None], rows[..., AgentColumn.VALID :]
    vectors = (offset, rows[..., AgentColumn.HEADING], rows[..., AgentColumn.VELOCITY])
    result = np.concatenate([*map(rotate, vectors), valid], axis=-1) * valid
    return result.reshape(-1, *result.shape[2:])
