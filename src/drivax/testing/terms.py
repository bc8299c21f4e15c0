"""Checks of what is read off measured moments: reward terms and metrics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.metrics.catalogue import EpisodeEnd, Metric
from drivax.metrics.scores import Value
from drivax.metrics.steps import Moment
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

#: The angle by which worlds are turned.
ANGLE = 1.3


def check_reward(term: Term | str) -> None:
    """Whether a reward term keeps to the rules.

    It is a pure function of facts before, facts now and surroundings; one finite float32 number; the same compiled or
    not, batched or alone, every time; and unchanged by turning and shifting the world, by the order of the agents, by
    padding, and by what rows hold where nobody is.

    Args:
        term: The term, or its dotted name.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    found: Any = find_named(term) if isinstance(term, str) else term
    found = found() if isinstance(found, type) else found
    what = f"reward term {name_of(found)!r}"

    def value(moment: Moments) -> Any:
        return found(moment.before, moment.found.facts, moment.found.surroundings)

    _check_moments(what, value, check_scalar)


def check_metric(metric: Metric | str) -> None:
    """Whether a metric keeps to the rules.

    Its step value is a number and whether it is defined, under the rules of :func:`check_reward` wherever it is
    defined; it says all facts that it looks at; unit, direction and text are there; what it computes at the end of an
    episode is a finite ``Value`` where it is defined.

    Args:
        metric: The metric, or its dotted name.

    Raises:
        BrokenContract: It does not; the message says which rule and what to do.
    """
    what = f"metric {metric!r}" if isinstance(metric, str) else f"metric {metric.definition!r}"
    found: Any = find_named(metric) if isinstance(metric, str) else metric
    expect(isinstance(found, Metric), f"{what} is not a Metric", "see metrics.catalogue.Metric")
    expect(
        found.unit and found.definition,
        f"{what} has no unit or definition",
        "tables and reports print them; '-' is the unit of shares",
    )
    if found.step_value is not None:
        step = found.step_value

        def value(moment: Moments) -> tuple[Any, Any]:
            now = Moment(moment.found, moment.start, jnp.ones((), bool))
            number, defined = step.read(now)
            number = jnp.asarray(number)
            defined = jnp.broadcast_to(jnp.asarray(defined, bool), number.shape)
            return jnp.where(defined, number.astype(jnp.float32), 0.0), defined

        _check_moments(what, value, check_scalar if not step.delayed else _check_rows)
        _check_reads(what, value, step.reads)
    if found.compute is not None:
        _check_computed(what, found)


def _check_moments(
    what: str, value: Callable[[Moments], Any], check_shape: Callable[[str, Any], None]
) -> None:
    moments, program = worlds.moments(), Program(what, value)
    results = program.check_pure(moments)
    check_shape(what, results[0] if isinstance(results, tuple) else results)
    frame = moments.found.surroundings.frame
    check_numbers(what, results)
    check_numbers(what, program(worlds.extremes(moments)))
    check_numbers(what, program(worlds.with_frame(moments, worlds.deserted_frame(frame))))
    variants = (
        (worlds.littered_frame, "rows hold something else where nobody is", "mask with frame.valid first"),
        (worlds.padded_frame, "there are more empty slots", "mask with frame.valid, also before a mean"),
        (
            worlds.shuffled_frame,
            "the agents stand in another order",
            "reduce over all of them; slot 0 is ego",
        ),
    )
    for change, cause, cure in variants:
        check_same(what, results, program(worlds.with_frame(moments, change(frame))), cause, cure)
    check_turned(what, results, program(worlds.moments(ANGLE)))


def _check_rows(what: str, value: Any) -> None:
    expect(
        np.asarray(value).ndim == 2,
        f"{what} is judged late but gives no row of numbers",
        "give one number and one mask entry per step that is judged",
    )


def _check_reads(what: str, value: Callable[[Moments], Any], reads: frozenset[str]) -> None:
    """Whether a value computes when the facts that it does not name are missing, as they are in a lean run."""
    unknown = sorted(reads - FACTS - ON_REQUEST)
    expect(not unknown, f"{what} reads {unknown[:1]}, which is no fact", "see simulator.types.Facts")
    moments = worlds.without_facts(worlds.moments(), reads)
    try:
        Program(what, value)(moments)
    except (AttributeError, TypeError, ValueError) as error:
        expect(False, f"{what} looks at a fact that 'reads' does not name ({error})", "name it there")


def _check_computed(what: str, metric: Metric) -> None:
    """What is computed at the end, for inputs from 0 to 1 that are defined or not."""
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
            "return drivax.metrics.scores.Value(number, defined)",
        )
        check_numbers(what, jax.tree.map(lambda leaf, d=result.defined: np.where(d, leaf, 0.0), result.value))
