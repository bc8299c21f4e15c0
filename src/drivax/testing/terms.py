"""Checks of reward terms, metrics, observation features and criticality methods."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.curation.logged import LoggedScenario, read_log
from drivax.metrics.catalogue import EpisodeEnd, Metric
from drivax.metrics.steps import Moment, Value
from drivax.plugins import find_named
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import alone
from drivax.simulator.types import AgentContext, Frame
from drivax.tasks.observations import Feature, OwnGroup
from drivax.tasks.rewards import Term
from drivax.tasks.task import Task
from drivax.testing import worlds
from drivax.testing.contract import (
    BatchedFunction,
    array_type,
    check_numbers,
    check_rotated,
    check_same,
    check_variants,
    expect,
    instance,
    label,
)
from drivax.testing.worlds import ANGLE, Moments

#: Largest feature value; the Gymnasium adapter clips at this bound.
LARGEST = 100.0
#: Step after which the log is changed, to check that features do not depend on the future.
_NOW = 45


def check_reward(term: Term | str) -> None:
    """Check a reward term or its dotted name; raise :class:`BrokenContract` if it violates a rule.

    It is a pure function of facts before, facts now and surroundings, with one finite float32 result. The result does
    not depend on compilation, batching, rotation and shift of the world, the order of agents, padding, or rows of
    absent agents.
    """
    function = instance(term)
    what = f"reward term {label(function)!r}"
    cure = "write a function of facts before, facts now and surroundings"
    expect(callable(function), f"{what} cannot be called", cure)

    def value(moment: Moments) -> Any:
        number = function(moment.before, moment.situation.facts, moment.situation.surroundings)
        problem = f"{what} gives {type(number).__name__} instead of one float32 number"
        expect(jax.tree.structure(number) == jax.tree.structure(0.0), problem, "return the number alone")
        return number

    _check_moments(what, value)


def check_metric(metric: Metric | str) -> None:
    """Check a metric or its dotted name; raise :class:`BrokenContract` if it violates a rule.

    It has a unit and a definition. Its step value, if any, is a number or boolean and whether it is defined (rows of
    both if delayed); a defined one follows the rules of :func:`check_reward`, and the metric declares all facts that it
    reads. ``compute``, if any, returns a ``Value`` at the end of an episode, which is finite if defined.
    """
    what = f"metric {getattr(metric, 'definition', metric)!r}"
    spec: Any = find_named(metric) if isinstance(metric, str) else metric
    expect(isinstance(spec, Metric), f"{what} is not a Metric", "see metrics.catalogue.Metric")
    cure = "tables and reports print them; '-' is the unit of fractions"
    expect(spec.unit and spec.definition, f"{what} has no unit or definition", cure)
    if spec.step_value is not None:
        step = spec.step_value

        def value(moment: Moments) -> tuple[Any, Any]:
            result = step.read(Moment(moment.situation, moment.start, jnp.ones((), bool)))
            is_pair = isinstance(result, tuple | list) and len(result) == 2
            expect(is_pair, f"{what} reads no pair", "return the number and whether it is defined")
            number, defined = jnp.asarray(result[0]), result[1]
            defined = jnp.broadcast_to(jnp.asarray(defined, bool), number.shape)
            return jnp.where(defined, number.astype(jnp.float32), 0.0), defined

        _check_moments(what, value, step.delayed)
        _check_reads(what, value, step.reads)
    if spec.compute is not None:
        _check_computed(what, spec)


def check_feature(feature: Feature | str) -> None:
    """Check an observation feature or its dotted name; raise :class:`BrokenContract` if it violates a rule.

    It is a pure function of bank, context and frames that returns finite float32 values in [-100, 100], with features
    on the last axis, optionally with a mask of rows. Results do not depend on compilation, batching, the log's future,
    rotation and shift of the world, the order of agents, padding, or rows of absent agents.
    """
    function: Any = find_named(feature) if isinstance(feature, str) else feature
    what = f"observation feature {label(function)!r}"
    cure = "write a function of bank, context and frames"
    expect(callable(function) and not isinstance(function, type), f"{what} is no function", cure)
    group = OwnGroup(function, "checked")
    simulator = Simulator(Task())

    def observe(bank: ScenarioBank, context: AgentContext) -> Any:
        def frames(back: int) -> Frame:
            return simulator.frame(bank, context, alone(context), back)

        _check_form(what, function(bank, context, frames))
        return group.observe(bank, context, frames)

    program = BatchedFunction(what, observe, (None, 0))
    bank, contexts = worlds.worlds(), worlds.moments().situation.context
    results = program.check_pure(bank, contexts)
    check_numbers(what, results)
    largest = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(results))
    expect(
        largest <= LARGEST, f"{what} reaches {largest:g}", "scale it to about [-1, 1] (units: tasks.features)"
    )
    check_numbers(what, program(worlds.without_others(bank), contexts))
    check_variants(what, results, worlds.BANK_VARIANTS, lambda change: program(change(bank), contexts))
    at_change = np.asarray(contexts.step) == _NOW
    changed = program(worlds.change_future(bank, _NOW), contexts)
    expected, changed = (jax.tree.map(lambda leaf: leaf[at_change], result) for result in (results, changed))
    cure = "read the context and its frames; of the bank only map, route 0, goal and the current step"
    check_same(what, expected, changed, "the log's future changes", cure)
    rotated = program(worlds.worlds(ANGLE), worlds.moments(ANGLE).situation.context)
    check_rotated(what, results, rotated)


def _check_form(what: str, rows: Any) -> None:
    """Check shapes and dtypes while tracing."""
    value: Any
    mask: Any
    value, mask = rows if isinstance(rows, tuple) and len(rows) == 2 else (rows, None)
    valid = hasattr(value, "dtype") and (mask is None or hasattr(mask, "dtype"))
    expect(valid, f"{what} gives {type(rows).__name__}", "return an array, or an array and its mask")
    valid = value.dtype == jnp.float32 and value.ndim >= 1
    cure = "return float32 with features on the last axis"
    expect(valid, f"{what} gives {array_type(value)} for a context", cure)
    if mask is not None:
        valid = mask.dtype == bool and mask.shape == value.shape[:-1] and mask.ndim > 0
        problem = f"{what} gives {array_type(mask)} as the mask of {list(value.shape)}"
        expect(valid, problem, "return one boolean per row")


def _check_moments(what: str, value: Callable[[Moments], Any], delayed: bool = False) -> None:
    moments, program = worlds.moments(), BatchedFunction(what, value)
    results = program.check_pure(moments)
    number = np.asarray(results[0] if isinstance(results, tuple) else results)
    if delayed:
        problem = f"{what} is delayed but returns no row of numbers"
        expect(number.ndim == 2, problem, "return one number and one mask entry per step")
    else:
        problem = f"{what} gives {array_type(number[0])} instead of one float32 number"
        cure = "reduce it to a scalar, and convert booleans with .astype(jnp.float32)"
        expect(number.ndim == 1 and number.dtype == jnp.float32, problem, cure)
    frame = moments.situation.surroundings.frame

    def results_of(change: Callable[[Frame], Frame]) -> Any:
        return program(worlds.with_frame(moments, change(frame)))

    check_numbers(what, results)
    check_numbers(what, program(worlds.extremes(moments)))
    check_numbers(what, results_of(worlds.frame_without_others))
    check_variants(what, results, worlds.FRAME_VARIANTS, results_of)
    check_rotated(what, results, program(worlds.moments(ANGLE)))


def _check_reads(what: str, value: Callable[[Moments], Any], reads: frozenset[str]) -> None:
    """Check that a value can be computed from its declared facts alone."""
    try:
        BatchedFunction(what, value)(worlds.without_facts(worlds.moments(), reads))
    except (AttributeError, TypeError, ValueError) as error:
        expect(False, f"{what} reads a fact that 'reads' does not declare ({error})", "add it to reads")


def _check_computed(what: str, metric: Metric) -> None:
    """Check ``compute`` for inputs from 0 to 1, defined and undefined."""
    compute = metric.compute
    assert compute is not None
    bank = worlds.worlds()

    def value(row: Any, number: Any, defined: Any) -> Any:
        end = EpisodeEnd(bank, row, jnp.asarray(10), jnp.asarray(80), row)
        step_value = Value(number, defined)
        return compute(end, step_value, dict.fromkeys(metric.inputs, step_value))

    program = BatchedFunction(what, value, (0, 0, 0))
    for defined in (True, False):
        rows = (jnp.arange(12) % len(bank), jnp.linspace(0.0, 1.0, 12), jnp.full(12, defined))
        result = program.check_pure(*rows) if defined else program(*rows)
        valid = isinstance(result, Value) and result.value.shape == result.defined.shape == (12,)
        valid = valid and result.defined.dtype == bool
        cure = "return drivax.metrics.Value(number, defined)"
        expect(valid, f"{what} does not compute a Value of one number and one boolean", cure)
        check_numbers(what, jax.tree.map(lambda leaf, d=result.defined: np.where(d, leaf, 0.0), result.value))


def check_criticality(method: Callable[[ScenarioBank, LoggedScenario], dict[str, Any]] | str) -> None:
    """Check a criticality method or its dotted name; raise :class:`BrokenContract` if it violates a rule.

    It is a pure, hashable function of a bank and the log of an ego. Its result is a dict of components, each with a
    float32 number in [0, 1] for every step. They do not depend on compilation, batching, rotation and shift of the
    world, the order of agents, padding, or rows of absent agents.
    """
    score = instance(method)
    what = f"criticality method {label(score)!r}"
    expect(callable(score), f"{what} cannot be called", "write a function of a bank and a log")
    try:
        hash(score)
    except TypeError:
        expect(False, f"{what} cannot be hashed", "make its dataclass frozen, with tuples instead of lists")

    def components(bank: ScenarioBank, row: Any) -> Any:
        values = score(bank, read_log(bank, row))
        expect(
            isinstance(values, dict) and values, f"{what} gives no dict of components", "name each of them"
        )
        for name, value in values.items():
            array = jnp.asarray(value)
            is_right = array.shape == (bank.steps,) and array.dtype == jnp.float32
            problem = f"component {name!r} of {what} is {array_type(array)}, not float32[{bank.steps}]"
            expect(is_right, problem, "return a number for every step of the log")
        return values

    program, bank = BatchedFunction(what, components, (None, 0)), worlds.worlds()
    rows = jnp.arange(len(bank))
    result = program.check_pure(bank, rows)
    check_numbers(what, result)
    for name, value in result.items():
        is_inside = (np.asarray(value) >= 0.0) & (np.asarray(value) <= 1.0)
        problem = f"component {name!r} of {what} is outside [0, 1] at {int((~is_inside).sum())} steps"
        expect(is_inside.all(), problem, "scale and clip it")
    check_variants(what, result, worlds.BANK_VARIANTS, lambda variant: program(variant(bank), rows))
    check_rotated(what, *jax.tree.map(np.ravel, (result, program(worlds.worlds(worlds.ANGLE), rows))))
