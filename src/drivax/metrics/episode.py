"""Metrics of an episode, accumulated in the graph: situation -> step values -> accumulators -> episode metrics.

Each accumulator has one entry per step value that some selected metric needs under that operator, and no other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.metrics.catalogue import EpisodeEnd, Metric, Operator
from drivax.metrics.selection import MetricNames, MetricSelection, select_metrics
from drivax.metrics.steps import STEP_VALUES, Moment, StepValue, Value
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import Flag
from drivax.simulator.types import SimState, Situation

_NEVER = 32767
#: Steps of one second (semantics, ``wrong_way``).
_SECOND = 10


@record
class Episode:
    """Accumulators of one episode.

    Attributes:
        total, count: Sum over the steps that define a value, and the number of those steps.
        low, high, last, first: Extremes, the last value, and the first one above zero (0 while there is none); NaN or
            infinite before any step defines one.
        event_step: Step of the first collision, off-road step and red light.
        second, worst: The last ten values, and the largest sum over ten consecutive steps.
        selection: The metrics that are accumulated.
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
    # Types as strong as those of later steps: else a program that steps is traced and compiled twice.
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
    """Add the step to ``situation``, in an episode that began at ``start``; ``final`` evaluates its last steps too."""
    selection, values = episode.selection, _entries(episode.selection)
    moment = _MomentValues(Moment(situation, start, final))
    added, number = moment.sums(values["total"])
    low, _ = moment.extremes(values["low"], jnp.min, jnp.inf)
    high, _ = moment.extremes(values["high"], jnp.max, -jnp.inf)
    last, last_counts = moment.extremes(values["last"], jnp.max, -jnp.inf)
    first, first_counts = moment.extremes(values["first"], jnp.max, -jnp.inf)
    waiting = first_counts & ~(episode.first > 0)
    happens, _ = moment.extremes(tuple(STEP_VALUES[name] for name in selection.events), jnp.max, 0.0)
    begins = (happens > 0) & (episode.event_step == _NEVER)
    window, _ = moment.sums(values["worst"])
    second = jnp.concatenate([episode.second[:, 1:], window[:, None]], axis=1)
    return Episode(
        total=episode.total + added,
        count=episode.count + number,
        low=jnp.minimum(episode.low, low),
        high=jnp.maximum(episode.high, high),
        last=jnp.where(last_counts, last, episode.last),
        first=jnp.where(waiting, first, episode.first),
        event_step=jnp.where(begins, situation.context.step.astype(jnp.int16), episode.event_step),
        second=second,
        worst=jnp.maximum(episode.worst, second.sum(axis=1)),
        selection=selection,
    )


class _MomentValues:
    """Step values of one moment, each read once."""

    def __init__(self, moment: Moment) -> None:
        self.moment = moment
        self.read: dict[StepValue, tuple[Array, Array]] = {}

    def _one(self, value: StepValue) -> tuple[Array, Array]:
        if value not in self.read:
            number, defined = value.read(self.moment)
            defined = jnp.broadcast_to(jnp.asarray(defined, bool), number.shape)
            self.read[value] = number.astype(jnp.float32), defined
        return self.read[value]

    def sums(self, values: Sequence[StepValue]) -> tuple[Float[Array, " R"], Int[Array, " R"]]:
        """Return the sums and the numbers of defined values."""
        pairs = [self._one(value) for value in values]
        total = [jnp.where(defined, number, 0.0).sum() for number, defined in pairs]
        count = [defined.sum(dtype=jnp.int16) for _, defined in pairs]
        return _stacked(total, jnp.float32), _stacked(count, jnp.int16)

    def extremes(
        self, values: Sequence[StepValue], reduce: Callable[[Array], Array], none: float
    ) -> tuple[Float[Array, " R"], Bool[Array, " R"]]:
        """Return the reduced defined values, ``none`` where there are none, and whether there are any."""
        pairs = [self._one(value) for value in values]
        best = [reduce(jnp.where(defined, number, none)) for number, defined in pairs]
        return _stacked(best, jnp.float32), _stacked([defined.any() for _, defined in pairs], jnp.bool_)


def _stacked(scalars: Sequence[Array], kind: type) -> Array:
    return jnp.stack(scalars) if scalars else jnp.zeros(0, kind)


def episode_metrics(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    """Return the selected metrics of the episode that ended in ``state``; undefined ones have the value 0."""
    context, episode = state.context, state.episode
    end = EpisodeEnd(bank, context.index, state.start, context.step - state.start)
    result: dict[str, Value] = {}
    for name, metric in episode.selection.metrics:
        value = _accumulated(episode, metric)
        if metric.compute is not None:
            value = metric.compute(end, value, result)
        defined = value.defined & _has(bank, state, metric.needs) & jnp.isfinite(value.value)
        result[name] = Value(jnp.where(defined, value.value, 0.0), defined)
    return {name: result[name] for name in episode.selection.names}


def _has(bank: ScenarioBank, state: SimState, needs: Flag) -> Bool[Array, ""]:
    """Whether the scenario has the flags that a metric needs; only ego has a route."""
    desired = jnp.uint32(int(needs))
    held = (bank.flags[state.context.index] & desired) == desired
    return held & ((Flag.ROUTE not in needs) | (state.context.slot == 0))


def _accumulated(episode: Episode, metric: Metric) -> Value:
    """Return an accumulated step value; undefined where no step defined it."""
    if metric.step_value is None:
        return Value(jnp.zeros(()), jnp.zeros((), bool))
    accumulator = next(name for name, operators in _ACCUMULATORS.items() if metric.operator in operators)
    row = _entries(episode.selection)[accumulator].index(metric.step_value)
    value = getattr(episode, accumulator)[row]
    if accumulator == "total":
        count = episode.count[row]
        mean = value / jnp.maximum(count, 1).astype(jnp.float32)
        return Value(mean if metric.operator == "mean" else value, count > 0)
    return Value((value > 0).astype(jnp.float32) if metric.operator == "any" else value, jnp.isfinite(value))


def event_steps(episode: Episode) -> dict[str, Int[Array, ""]]:
    """Return the steps of the first selected events (collision, off-road, red light); -1 for none."""
    return {
        name: jnp.where(episode.event_step[row] == _NEVER, -1, episode.event_step[row])
        for row, name in enumerate(episode.selection.events)
    }
