"""Checks of reward terms and metrics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.metrics.catalogue import EpisodeEnd, Metric
from drivax.metrics.steps import Moment, Value
from drivax.plugins import find_named
from drivax.simulator.types import FACTS, ON_REQUEST
from drivax.tasks.own import name_of
from drivax.tasks.rewards import Term
from drivax.testing import worlds
from drivax.testing.contract import (
    Program,
    check_numbers,
    check_same,
    check_scalar,
    check_turned,
    expect,
)
from drivax.testing.worlds import Moments

#: Rotation of worlds, rad.
ANGLE = 1.3


def check_reward(term: Term | str) -> None:
    """Check a reward term.

    It is a pure function of facts before, facts now and surroundings, and one finite float32 number. It does not
    depend on compilation, batching, rotation and shift of the world, the order of agents, padding, or rows of absent
    agents.

    Args:
        term: The term, or its dotted name.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    function: Any = find_named(term) if isinstance(term, str) else term
    function = function() if isinstance(function, type) else function
    what = f"reward term {name_of(function)!r}"

    def value(moment: Moments) -> Any:
        return function(moment.before, moment.situation.facts, moment.situation.surroundings)

    _check_moments(what, value, check_scalar)


def check_metric(metric: Metric | str) -> None:
    """Check a metric.

    Its step value is a number and whether it is defined, under the rules of :func:`check_reward` where it is defined.
    It declares all facts that it reads, has unit, direction and text, and computes a finite ``Value`` at the end of an
    episode where it is defined.

    Args:
        metric: The metric, or its dotted name.

    Raises:
        BrokenContract: It breaks a rule; the message names rule and cure.
    """
    what = f"metric {metric!r}" if isinstance(metric, str) else f"metric {metric.definition!r}"
    spec: Any = find_named(metric) if isinstance(metric, str) else metric
    expect(isinstance(spec, Metric), f"{what} is not a Metric", "see metrics.catalogue.Metric")
    expect(
        spec.unit and spec.definition,
        f"{what} has no unit or definition",
        "tables and reports print them; '-' is the unit of fractions",
    )
    if spec.step_value is not None:
        step = spec.step_value

        def value(moment: Moments) -> tuple[Any, Any]:
            now = Moment(moment.situation, moment.start, jnp.ones((), bool))
            number, defined = step.read(now)
            number = jnp.asarray(number)
            defined = jnp.broadcast_to(jnp.asarray(defined, bool), number.shape)
            return jnp.where(defined, number.astype(jnp.float32), 0.0), defined

        _check_moments(what, value, check_scalar if not step.delayed else _check_rows)
        _check_reads(what, value, step.reads)
    if spec.compute is not None:
        _check_computed(what, spec)


def _check_moments(
    what: str, value: Callable[[Moments], Any], check_shape: Callable[[str, Any], None]
) -> None:
    moments, program = worlds.moments(), Program(what, value)
    results = program.check_pure(moments)
    check_shape(what, results[0] if isinstance(results, tuple) else results)
    frame = moments.situation.surroundings.frame
    check_numbers(what, results)
    check_numbers(what, program(worlds.extremes(moments)))
    check_numbers(what, program(worlds.with_frame(moments, worlds.frame_without_others(frame))))
    variants = (
        (worlds.scattered_frame, "the rows of absent agents change", "mask with frame.valid first"),
        (worlds.padded_frame, "empty slots are added", "mask with frame.valid, also before a mean"),
        (
            worlds.shuffled_frame,
            "the order of agents changes",
            "reduce over all of them; slot 0 is ego",
        ),
    )
    for change, cause, cure in variants:
        check_same(what, results, program(worlds.with_frame(moments, change(frame))), cause, cure)
    check_turned(what, results, program(worlds.moments(ANGLE)))


def _check_rows(what: str, value: Any) -> None:
    expect(
        np.asarray(value).ndim == 2,
        f"{what} is delayed but returns no row of numbers",
        "return one number and one mask entry per step",
    )


def _check_reads(what: str, value: Callable[[Moments], Any], reads: frozenset[str]) -> None:
    """Check that a value computes without the facts that it does not declare."""
    unknown = sorted(reads - FACTS - ON_REQUEST)
    expect(not unknown, f"{what} reads unknown fact {unknown[:1]}", "see simulator.types.Facts")
    moments = worlds.without_facts(worlds.moments(), reads)
    try:
        Program(what, value)(moments)
    except (AttributeError, TypeError, ValueError) as error:
        expect(False, f"{what} reads a fact that 'reads' does not declare ({error})", "add it to reads")


def _check_computed(what: str, metric: Metric) -> None:
    """Check what is computed at the end, for inputs from 0 to 1, defined and undefined."""
    compute = metric.compute
    assert compute is not None
    bank = worlds.worlds()
    grid = jnp.linspace(0.0, 1.0, 12)

    def value(row: Any, number: Any, defined: Any) -> Any:
        ending = EpisodeEnd(bank, row, jnp.asarray(10), jnp.asarray(80))
        given = Value(number, defined)
        return compute(ending, given, dict.fromkeys(metric.inputs, given))

    program = Program(what, value, (0, 0, 0))
    for defined in (True, False):
        rows = (jnp.arange(12) % len(bank), grid, jnp.full(12, defined))
        result = program.check_pure(*rows) if defined else program(*rows)
        expect(
            isinstance(result, Value) and result.value.shape == (12,) and result.defined.dtype == bool,
            f"{what} does not compute a Value of one number and one boolean",
            "return drivax.metrics.steps.Value(number, defined)",
        )
        check_numbers(what, jax.tree.map(lambda leaf, d=result.defined: np.where(d, leaf, 0.0), result.value))
