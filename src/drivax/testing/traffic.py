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
from drivax.simulator.traffic.catalogue import make_traffic
from drivax.simulator.traffic.log import alone, logged_history
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

#: Steps at which the models begin, and how many they go on.
_BEGIN, _STEPS = 20, 12
#: Nobody moves further in one step, m.
_LEAP_M = 8.0
#: What the state of one environment may take with traffic that reacts, bytes.
_STATE_BYTES = 16_000


@record
class _Seen:
    """What a model said over some steps: rows now, the same one step later, and the ego that they are seen from."""

    rows: Any
    remembered: Any
    view: View


def check_traffic(traffic: Traffic | str) -> None:
    """Whether a traffic model keeps to the rules.

    Its state keeps its form and is small; its rows are those of ``bank.agents``: finite, unit directions, valid 0 or 1;
    what it says of the past is what it said then; nobody leaps; it is the same compiled or not, batched or alone, every
    time; and it does not change with the turn and place of the world, the order of the agents, padding, or what rows
    hold where nobody is.

    Args:
        traffic: The model, its name, or the dotted name of such a class.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    traffic = make_traffic(traffic) if isinstance(traffic, str) else traffic
    what = f"traffic {traffic.name!r}"
    bank = prepare_bank(traffic, worlds.worlds())
    _check_state(what, traffic, bank)
    index, program = jnp.arange(len(bank)), Program(what, _driven(traffic), (None, 0))
    seen: _Seen = program.check_pure(bank, index)
    _check_rows(what, seen)
    there = seen.rows[..., AgentColumn.VALID] > 0

    def told(change: Callable[[ScenarioBank], ScenarioBank]) -> Any:
        return program(prepare_bank(traffic, change(worlds.worlds())), index).rows

    check_numbers(what, told(worlds.deserted))
    known = np.where(there[..., None], seen.rows, 0.0)
    littered = told(worlds.littered)
    valid = littered[..., AgentColumn.VALID :] > 0
    check_same(
        what,
        known,
        np.where(valid, littered, 0.0),
        "rows hold something else where nobody is",
        "mask with frame.valid first",
    )
    longer = told(worlds.padded)[:, :, : there.shape[-1]]
    check_same(
        what,
        known,
        np.where(longer[..., AgentColumn.VALID :] > 0, longer, 0.0),
        "there are more empty slots",
        "mask with frame.valid, also before a mean",
    )
    mixed = told(worlds.shuffled)
    wanted = known[:, :, worlds.order_of(there.shape[-1])]
    check_same(
        what,
        wanted,
        np.where(mixed[..., AgentColumn.VALID :] > 0, mixed, 0.0),
        "the agents stand in another order",
        "let no agent's motion follow from its slot",
    )
    turned = program(prepare_bank(traffic, worlds.worlds(ANGLE)), index)
    check_turned(what, _from_ego(seen), _from_ego(turned))


def _driven(traffic: Traffic) -> Callable[[ScenarioBank, Any], _Seen]:
    """Ego replays its log; everyone else is moved by the model."""
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

        return jax.lax.scan(step, simulator.context(bank, index, _BEGIN), None, _STEPS)[1]

    return drive


def _check_state(what: str, traffic: Traffic, bank: ScenarioBank) -> None:
    simulator = Simulator(Task(), traffic)

    def told(bank: ScenarioBank) -> Any:
        return traffic.agents(bank, simulator.context(bank, 0, _BEGIN), 0)

    rows, shape = jax.eval_shape(told, bank), bank.agents.shape[2:]
    expect(
        rows.shape == shape and rows.dtype == jnp.float32,
        f"{what} gives {rows.dtype}{list(rows.shape)} as the rows of {shape[0]} agents",
        "give float32 rows as those of bank.agents[index, step]",
    )

    def following(bank: ScenarioBank) -> tuple[Any, Any]:
        context = simulator.context(bank, 0, _BEGIN)
        frame = simulator.frame(bank, context, alone(context), 0)
        return context.traffic, traffic.advance(bank, context, frame)

    first, second = jax.eval_shape(following, bank)
    forms = [
        (jax.tree.structure(s), [(x.shape, x.dtype) for x in jax.tree.leaves(s)]) for s in (first, second)
    ]
    expect(
        forms[0] == forms[1],
        f"{what} changes the form of its state in a step",
        "return from advance what start returned: the same structure, shapes and types",
    )
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(first))
    expect(
        size <= _STATE_BYTES,
        f"{what} carries {size} bytes per environment",
        f"keep at most {_STATE_BYTES}; what follows from the bank alone belongs into prepare(bank)",
    )


def _check_rows(what: str, seen: _Seen) -> None:
    check_numbers(what, seen.rows)
    rows, remembered = seen.rows[:, :, 1:], seen.remembered[:, :, 1:]
    valid = rows[..., AgentColumn.VALID]
    expect(np.isin(valid, (0.0, 1.0)).all(), f"{what} has agents that are half valid", "let valid be 0 or 1")
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
        f"{what} says another thing of the past than it said then",
        "let agents(bank, context, back) tell where everyone was 'back' steps ago",
    )
    both = there[:, 1:] & there[:, :-1]
    leap = np.linalg.norm(np.diff(rows[..., :2], axis=1), axis=-1)[both]
    expect(
        (leap <= _LEAP_M).all(),
        f"{what} moves an agent by {leap.max(initial=0.0):.1f} m in a step",
        "a step lasts 0.1 s; who goes is invalid before somebody else takes the slot",
    )


def _from_ego(seen: _Seen) -> Any:
    """Valid rows in the ego frame, one moment per row."""
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
    told = np.concatenate(parts, axis=-1) * rows[..., AgentColumn.VALID :]
    return told.reshape(-1, *told.shape[2:])
