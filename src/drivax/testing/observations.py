"""Checks of observation features."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.plugins import find_named
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import alone
from drivax.simulator.types import AgentContext, Frame
from drivax.tasks.observations import Feature, OwnGroup
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    Program,
    check_numbers,
    check_same,
    check_turned,
    expect,
)
from drivax.testing.terms import ANGLE

#: Larger values are cut off by the Gymnasium adapter, and no network learns from them.
LARGEST = 100.0
#: The step up to which the log is known when it is checked that a feature does not see what follows.
_NOW = 45


def check_feature(feature: Feature | str) -> None:
    """Whether an observation feature keeps to the rules.

    It is a pure function of bank, context and frames; finite float32 of at most 100 with features last, or a pair of
    that and a mask over its rows; the same compiled or not, batched or alone, every time; it sees nothing of the log's
    future; and it is unchanged by turning and shifting the world, by the order of the agents, by padding, and by what
    rows hold where nobody is.

    Args:
        feature: The feature, or its dotted name.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    found: Any = find_named(feature) if isinstance(feature, str) else feature
    group = OwnGroup(found)
    what = f"observation feature {group.name!r}"
    simulator = Simulator(Task())

    def seen(bank: ScenarioBank, context: AgentContext) -> Any:
        def frames(back: int) -> Frame:
            return simulator.frame(bank, context, alone(context), back)

        _check_form(what, found(bank, context, frames))
        return group.observe(bank, context, frames)

    program = Program(what, seen, (None, 0))
    bank, contexts = worlds.worlds(), worlds.moments().found.context
    results = program.check_pure(bank, contexts)
    check_numbers(what, results)
    largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(results))
    expect(
        largest <= LARGEST,
        f"{what} reaches {largest:g}",
        "scale it to about [-1, 1] (tasks.observations has the units of the others)",
    )
    check_numbers(what, program(worlds.deserted(bank), contexts))
    variants = (
        (worlds.littered, "rows hold something else where nobody is", "mask with frame.valid first"),
        (worlds.padded, "there are more empty slots", "mask with frame.valid, and let no size follow theirs"),
        (
            worlds.shuffled,
            "the agents stand in another order",
            "sort by distance, or reduce over all of them",
        ),
    )
    for change, cause, cure in variants:
        check_same(what, results, program(change(bank), contexts), cause, cure)
    present = np.asarray(contexts.step) == _NOW
    now, later = (
        jax.tree.map(lambda leaf: leaf[present], told)
        for told in (results, program(worlds.forgotten(bank, _NOW), contexts))
    )
    cure = "read the context and its frames; of the bank only map, route 0, goal and the present step"
    check_same(what, now, later, "the log's future changes", cure)
    turned = program(worlds.worlds(ANGLE), worlds.moments(ANGLE).found.context)
    check_turned(what, results, turned)


def _check_form(what: str, found: Any) -> None:
    """Shapes and types, which are known while a program is traced."""
    value, mask = found if isinstance(found, tuple) else (found, None)
    expect(
        value.dtype == jnp.float32 and value.ndim >= 1,
        f"{what} gives {value.dtype}{list(value.shape)} for a context",
        "give float32 with the features on the last axis",
    )
    if mask is not None:
        expect(
            mask.dtype == bool and mask.shape == value.shape[:-1] and mask.ndim > 0,
            f"{what} gives {mask.dtype}{list(mask.shape)} as the mask of {list(value.shape)}",
            "give one boolean per row",
        )
