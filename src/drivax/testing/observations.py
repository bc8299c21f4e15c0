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

#: Bound of features: the Gymnasium adapter clips there.
LARGEST = 100.0
#: Step after which the log is changed, to check that a feature does not see the future.
_NOW = 45


def check_feature(feature: Feature | str) -> None:
    """Check an observation feature.

    It is a pure function of bank, context and frames: finite float32 up to 100 with features last, or a pair of those
    and a mask over rows. It does not depend on compilation, batching, the log's future, rotation and shift of the
    world, the order of agents, padding, or rows of absent agents.

    Args:
        feature: The feature, or its dotted name.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    function: Any = find_named(feature) if isinstance(feature, str) else feature
    group = OwnGroup(function)
    what = f"observation feature {group.name!r}"
    simulator = Simulator(Task())

    def seen(bank: ScenarioBank, context: AgentContext) -> Any:
        def frames(back: int) -> Frame:
            return simulator.frame(bank, context, alone(context), back)

        _check_form(what, function(bank, context, frames))
        return group.observe(bank, context, frames)

    program = Program(what, seen, (None, 0))
    bank, contexts = worlds.worlds(), worlds.moments().situation.context
    results = program.check_pure(bank, contexts)
    check_numbers(what, results)
    largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(results))
    expect(
        largest <= LARGEST,
        f"{what} reaches {largest:g}",
        "scale it to about [-1, 1] (units: tasks.features)",
    )
    check_numbers(what, program(worlds.without_others(bank), contexts))
    variants = (
        (worlds.scattered, "the rows of absent agents change", "mask with frame.valid first"),
        (
            worlds.padded,
            "empty slots are added",
            "mask with frame.valid; no result may depend on the number of slots",
        ),
        (
            worlds.shuffled,
            "the order of agents changes",
            "sort by distance, or reduce over all of them",
        ),
    )
    for change, cause, cure in variants:
        check_same(what, results, program(change(bank), contexts), cause, cure)
    present = np.asarray(contexts.step) == _NOW
    now, later = (
        jax.tree.map(lambda leaf: leaf[present], result)
        for result in (results, program(worlds.other_future(bank, _NOW), contexts))
    )
    cure = "read the context and its frames; of the bank only map, route 0, goal and the current step"
    check_same(what, now, later, "the log's future changes", cure)
    turned = program(worlds.worlds(ANGLE), worlds.moments(ANGLE).situation.context)
    check_turned(what, results, turned)


def _check_form(what: str, rows: Any) -> None:
    """Check shapes and types, while tracing."""
    value, mask = rows if isinstance(rows, tuple) else (rows, None)
    expect(
        value.dtype == jnp.float32 and value.ndim >= 1,
        f"{what} gives {value.dtype}{list(value.shape)} for a context",
        "return float32 with features on the last axis",
    )
    if mask is not None:
        expect(
            mask.dtype == bool and mask.shape == value.shape[:-1] and mask.ndim > 0,
            f"{what} gives {mask.dtype}{list(mask.shape)} as the mask of {list(value.shape)}",
            "return one boolean per row",
        )
