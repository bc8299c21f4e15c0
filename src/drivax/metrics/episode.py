"""Accumulate the metrics of an episode: situation -> step values -> accumulators -> episode metrics.

Accumulators hold only the step values that the selected metrics need under their operators.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.metrics.catalogue import (
    EpisodeEnd,
    Metric,
    MetricNames,
    MetricSelection,
    Operator,
    select_metrics,
)
from drivax.metrics.steps import STEP_VALUES, Moment, StepValue, Value
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import Flag
from drivax.simulator.ahead import has_route
from drivax.simulator.types import SimState, Situation

#: ``event_step`` before an event.
_NEVER = 32767
#: Steps per second, the window of the operator ``worst_second``.
_SECOND = 10


@record
class Episode:
    """Accumulators of one episode.

    Attributes:
        total, count: Sum of the defined values, and their number.
        low, high, last, first: Minimum, maximum, last value, and first value above zero (the last value until there is
            one); NaN or infinite before the first defined value.
        event_step: Step of the first collision, off-road position and red-light violation, if selected; 32767 before.
        second, worst: The last ten values, and the largest sum over ten consecutive steps.
        selection: The accumulated metrics.
    """

    total: Float[Array, "*batch total"]
    count: Int[Array, "*batch total"]
    low: Float[Array, "*batch low"]
    high: Float[Array, "*batch high"]
    last: Float[Array, "*batch last"]
    first: Float[Array, "*batch first"]
    event_step: Int[Array, "*batch events"]
    second: Float[Array, "*batch windows 10"]
    worst: Float[Array, "*batch windows"]
    selection: MetricSelection = static()


#: Operators that read each accumulator.
_ACCUMULATORS: dict[str, tuple[Operator, ...]] = {
    "total": ("sum", "mean"), "low": ("min",), "high": ("any", "max"), "last": ("last",), "first": ("first",),
    "worst": ("worst_second",),
}  # fmt: skip


def _entries(selection: MetricSelection) -> dict[str, tuple[StepValue, ...]]:
    """Return the step values of each accumulator."""
    return {name: selection.step_values(*operators) for name, operators in _ACCUMULATORS.items()}


def episode_start(metrics: MetricNames = "full") -> Episode:
    """Return the accumulators of an episode without steps."""
    selection = select_metrics(metrics)
    size = {name: len(values) for name, values in _entries(selection).items()}
    # Strong types, as in later steps; weak ones would cause a second compilation.
    full = partial(jnp.full, dtype=float)
    return Episode(
        total=jnp.zeros(size["total"]),
        count=jnp.zeros(size["total"], jnp.int16),
        low=full(size["low"], jnp.inf),
        high=full(size["high"], -jnp.inf),
        last=full(size["last"], jnp.nan),
        first=full(size["first"], jnp.nan),
        event_step=jnp.full(len(selection.events), _NEVER, jnp.int16),
        second=jnp.zeros((size["worst"], _SECOND)),
        worst=full(size["worst"], -jnp.inf),
        selection=selection,
    )


def episode_add(
    episode: Episode, situation: Situation, start: Int[Array, ""], final: Bool[Array, ""]
) -> Episode:
    """Return the accumulators after a step of an episode that began at ``start``; ``final`` marks its last step."""
    selection, values = episode.selection, _entries(episode.selection)
    moment = _MomentValues(Moment(situation, start, final))
    total, count = moment.sums(values["total"])
    low, _ = moment.extremes(values["low"], jnp.min, jnp.inf)
    high, _ = moment.extremes(values["high"], jnp.max, -jnp.inf)
    last, last_defined = moment.extremes(values["last"], jnp.max, -jnp.inf)
    first, first_defined = moment.extremes(values["first"], jnp.max, -jnp.inf)
    is_first = first_defined & ~(episode.first > 0)
    event_values, _ = moment.extremes(tuple(STEP_VALUES[name] for name in selection.events), jnp.max, 0.0)
    is_event = (event_values > 0) & (episode.event_step == _NEVER)
    step_sums, _ = moment.sums(values["worst"])
    second = jnp.concatenate([episode.second[:, 1:], step_sums[:, None]], axis=1)
    return Episode(
        total=episode.total + total,
        count=episode.count + count,
        low=jnp.minimum(episode.low, low),
        high=jnp.maximum(episode.high, high),
        last=jnp.where(last_defined, last, episode.last),
        first=jnp.where(is_first, first, episode.first),
        event_step=jnp.where(is_event, situation.context.step.astype(jnp.int16), episode.event_step),
        second=second,
        worst=jnp.maximum(episode.worst, second.sum(axis=1)),
        selection=selection,
    )


class _MomentValues:
    """Step values of one moment, each computed once."""

    def __init__(self, moment: Moment) -> None:
        self.moment = moment
        self.values: dict[StepValue, tuple[Array, Array]] = {}

    def _read(self, value: StepValue) -> tuple[Array, Array]:
        if value not in self.values:
            number, defined = value.read(self.moment)
            defined = jnp.broadcast_to(jnp.asarray(defined, bool), number.shape)
            self.values[value] = number.astype(jnp.float32), defined
        return self.values[value]

    def sums(self, values: Sequence[StepValue]) -> tuple[Float[Array, " R"], Int[Array, " R"]]:
        """Return the sums and numbers of the defined values."""
        pairs = [self._read(value) for value in values]
        total = [jnp.where(defined, number, 0.0).sum() for number, defined in pairs]
        count = [defined.sum(dtype=jnp.int16) for _, defined in pairs]
        return _stack(total, jnp.float32), _stack(count, jnp.int16)

    def extremes(
        self, values: Sequence[StepValue], reduce: Callable[[Array], Array], default: float
    ) -> tuple[Float[Array, " R"], Bool[Array, " R"]]:
        """Return the extreme defined values, ``default`` if none is defined, and whether any is."""
        pairs = [self._read(value) for value in values]
        extremes = [reduce(jnp.where(defined, number, default)) for number, defined in pairs]
        return _stack(extremes, jnp.float32), _stack([defined.any() for _, defined in pairs], jnp.bool_)


def _stack(scalars: Sequence[Array], dtype: type) -> Array:
    return jnp.stack(scalars) if scalars else jnp.zeros(0, dtype)


def episode_metrics(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    """Return the selected metrics of the episode that ended in ``state``; undefined metrics have the value 0."""
    context, episode = state.context, state.episode
    end = EpisodeEnd(bank, context.index, state.start, context.step - state.start, context.row)
    result: dict[str, Value] = {}
    for name, metric in episode.selection.metrics:
        value = _accumulated_value(episode, metric)
        if metric.compute is not None:
            value = metric.compute(end, value, result)
        defined = value.defined & _meets(bank, state, metric.needs) & jnp.isfinite(value.value)
        result[name] = Value(jnp.where(defined, value.value, 0.0), defined)
    return {name: result[name] for name in episode.selection.names}


def _meets(bank: ScenarioBank, state: SimState, needs: Flag) -> Bool[Array, ""]:
    """Return whether the scenario has all flags of ``needs``, and the agent the route if it is one of them."""
    required = jnp.uint32(int(needs & ~Flag.ROUTE))
    has_flags = (bank.flags[state.context.index] & required) == required
    return has_flags & ((Flag.ROUTE not in needs) | has_route(bank, state.context))


def _accumulated_value(episode: Episode, metric: Metric) -> Value:
    """Return the reduced step value of a metric; undefined if no step defined it."""
    if metric.step_value is None:
        return Value(jnp.zeros(()), jnp.zeros((), bool))
    accumulator = next(name for name, operators in _ACCUMULATORS.items() if metric.operator in operators)
    index = _entries(episode.selection)[accumulator].index(metric.step_value)
    value = getattr(episode, accumulator)[index]
    if accumulator == "total":
        count = episode.count[index]
        mean = value / jnp.maximum(count, 1).astype(jnp.float32)
        return Value(mean if metric.operator == "mean" else value, count > 0)
    return Value((value > 0).astype(jnp.float32) if metric.operator == "any" else value, jnp.isfinite(value))


def event_steps(episode: Episode) -> dict[str, Int[Array, ""]]:
    """Return the first step of each selected event (collision, off-road, red light); -1 for none."""
    return {
        name: jnp.where(episode.event_step[index] == _NEVER, -1, episode.event_step[index])
        for index, name in enumerate(episode.selection.events)
    }
