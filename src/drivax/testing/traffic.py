"""Checks of traffic models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import alone, logged_history
from drivax.simulator.traffic.reactive import make_traffic
from drivax.simulator.types import AgentContext, Traffic
from drivax.tasks.observations import View
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    CLOSE,
    Program,
    check_numbers,
    check_same,
    check_turned,
    expect,
)
from drivax.testing.terms import ANGLE

#: First step and number of steps.
_START, _STEPS = 20, 12
#: Largest movement in one step, m.
_JUMP_M = 8.0
#: Largest state of one environment with reactive traffic, bytes.
_STATE_BYTES = 16_000


@record
class _Seen:
    """Rows of a model over some steps: now, the same one step later, and the ego frame."""

    rows: Any
    remembered: Any
    view: View


def check_traffic(traffic: Traffic | str) -> None:
    """Check a traffic model.

    Its state keeps its shape and is small. Its rows are like ``bank.agents``: finite, unit directions, valid 0 or 1.
    Past rows are repeated unchanged; no agent jumps. It does not depend on compilation, batching, rotation and shift
    of the world, the order of agents, padding, or rows of absent agents.

    Args:
        traffic: The model, its name, or the dotted name of such a class.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
    what = f"traffic {traffic.name!r}"
    bank = prepare_bank(traffic, worlds.worlds())
    _check_state(what, traffic, bank)
    index, program = jnp.arange(len(bank)), Program(what, _driven(traffic), (None, 0))
    seen: _Seen = program.check_pure(bank, index)
    _check_rows(what, seen)
    there = seen.rows[..., AgentColumn.VALID] > 0

    def rows_of(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        return program(prepare_bank(traffic, change(worlds.worlds())), index).rows

    check_numbers(what, rows_of(worlds.without_others))
    known = np.where(there[..., None], seen.rows, 0.0)
    scattered = rows_of(worlds.scattered)
    valid = scattered[..., AgentColumn.VALID :] > 0
    check_same(
        what,
        known,
        np.where(valid, scattered, 0.0),
        "the rows of absent agents change",
        "mask with frame.valid first",
    )
    longer = rows_of(worlds.padded)[:, :, : there.shape[-1]]
    check_same(
        what,
        known,
        np.where(longer[..., AgentColumn.VALID :] > 0, longer, 0.0),
        "empty slots are added",
        "mask with frame.valid, also before a mean",
    )
    mixed = rows_of(worlds.shuffled)
    expected = known[:, :, worlds.order_of(there.shape[-1])]
    check_same(
        what,
        expected,
        np.where(mixed[..., AgentColumn.VALID :] > 0, mixed, 0.0),
        "the order of agents changes",
        "let no motion depend on the slot",
    )
    turned = program(prepare_bank(traffic, worlds.worlds(ANGLE)), index)
    check_turned(what, _from_ego(seen), _from_ego(turned))


def _driven(traffic: Traffic) -> Callable[[ScenarioBank, Any], _Seen]:
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

    def first_rows(bank: ScenarioBank) -> Any:
        return traffic.agents(bank, simulator.context(bank, 0, _START), 0)

    rows, shape = jax.eval_shape(first_rows, bank), bank.agents.shape[2:]
    expect(
        rows.shape == shape and rows.dtype == jnp.float32,
        f"{what} gives {rows.dtype}{list(rows.shape)} as the rows of {shape[0]} agents",
        "return float32 rows like bank.agents[index, step]",
    )

    def states(bank: ScenarioBank) -> tuple[Any, Any]:
        context = simulator.context(bank, 0, _START)
        frame = simulator.frame(bank, context, alone(context), 0)
        return context.traffic, traffic.advance(bank, context, frame)

    first, second = jax.eval_shape(states, bank)
    forms = [
        (jax.tree.structure(s), [(x.shape, x.dtype) for x in jax.tree.leaves(s)]) for s in (first, second)
    ]
    expect(
        forms[0] == forms[1],
        f"{what} changes the shape of its state in a step",
        "return from advance the same structure, shapes and types as from start",
    )
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(first))
    expect(
        size <= _STATE_BYTES,
        f"{what} carries {size} bytes per environment",
        f"keep at most {_STATE_BYTES}; move what depends on the bank only to prepare(bank)",
    )


def _check_rows(what: str, seen: _Seen) -> None:
    check_numbers(what, seen.rows)
    rows, remembered = seen.rows[:, :, 1:], seen.remembered[:, :, 1:]
    valid = rows[..., AgentColumn.VALID]
    expect(np.isin(valid, (0.0, 1.0)).all(), f"{what} has fractional valid", "let valid be 0 or 1")
    there = valid > 0
    length = np.hypot(rows[..., 3], rows[..., 4])
    expect(
        np.allclose(length[there], 1.0, atol=1e-3),
        f"{what} has directions of length {length[there].min():.3g} to {length[there].max():.3g}",
        "columns 3 and 4 are cosine and sine of the heading",
    )
    expect(
        (remembered[..., AgentColumn.VALID] == valid).all()
        and np.allclose(remembered[there], rows[there], rtol=CLOSE, atol=1e-2),
        f"{what} changes past rows",
        "let agents(bank, context, back) return all agents 'back' steps ago",
    )
    both = there[:, 1:] & there[:, :-1]
    jump = np.linalg.norm(np.diff(rows[..., :2], axis=1), axis=-1)[both]
    expect(
        (jump <= _JUMP_M).all(),
        f"{what} moves an agent by {jump.max(initial=0.0):.1f} m in a step",
        "a step lasts 0.1 s; a slot is invalid before another agent takes it",
    )


def _from_ego(seen: _Seen) -> Any:
    """Return valid rows in the ego frame, one moment per row."""
    rows = np.asarray(seen.rows)[:, :, 1:]
    cos, sin = (np.asarray(part)[..., None] for part in (seen.view.cos, seen.view.sin))

    def ahead(vector: Any) -> Any:
        x, y = vector[..., 0], vector[..., 1]
        return np.stack([x * cos + y * sin, y * cos - x * sin], axis=-1)

    offset = rows[..., :2] - np.asarray(seen.view.xy)[:, :, None]
    parts = [
        ahead(offset),
        ahead(rows[..., AgentColumn.HEADING]),
        ahead(rows[..., AgentColumn.VELOCITY]),
        rows[..., AgentColumn.VALID :],
    ]
    result = np.concatenate(parts, axis=-1) * rows[..., AgentColumn.VALID :]
    return result.reshape(-1, *result.shape[2:])
