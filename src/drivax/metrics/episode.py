"""Metrics of an episode, accumulated in the graph: situation -> step values -> accumulators -> episode metrics.

Each accumulator has one entry per step value that some selected metric needs under that operator, and no other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.metrics.catalogue import EpisodeEnd, Metric, Operator
from drivax.metrics.scores import Value
from drivax.metrics.selection import MetricNames, MetricSelection, select_metrics
from drivax.metrics.steps import STEP_VALUES, Moment, StepValue
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
        total, count: Sums over the steps that define a value, and how many those are.
        low, high, last, first: Extremes, the last value, and the first one above zero (0 while there is none); NaN or
            infinite before any step defines one.
        event_step: Step of the first collision, off-road step and red light.
        second, worst: The last ten values, and the largest sum over ten steps on end.
        selection: What is accumulated for what.
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


#: Which operators read which accumulator.
_ADDED: tuple[Operator, ...] = ("sum", "mean")
_HIGH: tuple[Operator, ...] = ("any", "max")
_WORST: tuple[Operator, ...] = ("worst_second",)


def episode_start(metrics: MetricNames = "full") -> Episode:
    """Accumulators of an episode with no step yet."""
    selection = select_metrics(metrics)
    added, high = len(selection.step_values(*_ADDED)), len(selection.step_values(*_HIGH))
    windows = len(selection.step_values(*_WORST))
    # Types as strong as those of later steps: else a program that steps is traced and compiled twice.
    full = partial(jnp.full, dtype=float)
    return Episode(
        total=jnp.zeros(added),
        count=jnp.zeros(added, jnp.int16),
        low=full(len(selection.step_values("min")), jnp.inf),
        high=full(high, -jnp.inf),
        last=full(len(selection.step_values("last")), jnp.nan),
        first=full(len(selection.step_values("first")), jnp.nan),
        event_step=jnp.full(len(selection.events), _NEVER, jnp.int16),
        second=jnp.zeros((windows, _SECOND)),
        worst=full(windows, -jnp.inf),
        selection=selection,
    )


def episode_add(episode: Episode, found: Situation, start: Int[Array, ""], final: Bool[Array, ""]) -> Episode:
    """Adds a step.

    Args:
        episode: Accumulators so far.
        found: What the step led to.
        start: Step at which the episode began.
        final: The episode ends here, so the comfort of its last steps is evaluated too.
    """
    selection, seen = episode.selection, _Seen(Moment(found, start, final))
    added, number = seen.sums(selection.step_values(*_ADDED))
    low, _ = seen.extremes(selection.step_values("min"), jnp.min, jnp.inf)
    high, _ = seen.extremes(selection.step_values(*_HIGH), jnp.max, -jnp.inf)
    last, last_counts = seen.extremes(selection.step_values("last"), jnp.max, -jnp.inf)
    first, first_counts = seen.extremes(selection.step_values("first"), jnp.max, -jnp.inf)
    waiting = first_counts & ~(episode.first > 0)
    happens, _ = seen.extremes(tuple(STEP_VALUES[name] for name in selection.events), jnp.max, 0.0)
    begins = (happens > 0) & (episode.event_step == _NEVER)
    window, _ = seen.sums(selection.step_values(*_WORST))
    second = jnp.concatenate([episode.second[:, 1:], window[:, None]], axis=1)
    return Episode(
        total=episode.total + added,
        count=episode.count + number,
        low=jnp.minimum(episode.low, low),
        high=jnp.maximum(episode.high, high),
        last=jnp.where(last_counts, last, episode.last),
        first=jnp.where(waiting, first, episode.first),
        event_step=jnp.where(begins, found.context.step.astype(jnp.int16), episode.event_step),
        second=second,
        worst=jnp.maximum(episode.worst, second.sum(axis=1)),
        selection=selection,
    )


class _Seen:
    """The step values of one moment, each read once."""

    def __init__(self, moment: Moment) -> None:
        self.moment = moment
        self.read: dict[StepValue, tuple[Array, Array]] = {}

    def _one(self, value: StepValue) -> tuple[Array, Array]:
        if value not in self.read:
            number, defined = value.read(self.moment)
            self.read[value] = (
                number.astype(jnp.float32),
                jnp.broadcast_to(jnp.asarray(defined, bool), number.shape),
            )
        return self.read[value]

    def sums(self, values: Sequence[StepValue]) -> tuple[Float[Array, " R"], Int[Array, " R"]]:
        """Sums of defined values, and how many they are."""
        pairs = [self._one(value) for value in values]
        total = [jnp.where(defined, number, 0.0).sum() for number, defined in pairs]
        count = [defined.sum(dtype=jnp.int16) for _, defined in pairs]
        return _stacked(total, jnp.float32), _stacked(count, jnp.int16)

    def extremes(
        self, values: Sequence[StepValue], reduce: Callable[[Array], Array], none: float
    ) -> tuple[Float[Array, " R"], Bool[Array, " R"]]:
        """The smallest or largest defined values, ``none`` where there are none; and where there are any."""
        pairs = [self._one(value) for value in values]
        best = [reduce(jnp.where(defined, number, none)) for number, defined in pairs]
        return _stacked(best, jnp.float32), _stacked([defined.any() for _, defined in pairs], jnp.bool_)


def _stacked(scalars: Sequence[Array], kind: type) -> Array:
    return jnp.stack(scalars) if scalars else jnp.zeros(0, kind)


def episode_metrics(bank: ScenarioBank, state: SimState) -> dict[str, Value]:
    """The selected metrics of the episode that ``state`` ended, by name; undefined ones have the value 0."""
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
    """Whether the scenario has what a metric needs. The route is ego's; other slots have none."""
    desired = jnp.uint32(int(needs))
    held = (bank.flags[state.context.index] & desired) == desired
    return held & ((Flag.ROUTE not in needs) | (state.context.slot == 0))


def _accumulated(episode: Episode, metric: Metric) -> Value:
    """An accumulated step value; undefined where no step defined it."""
    if metric.step_value is None:
        return Value(jnp.zeros(()), jnp.zeros((), bool))
    step_values = episode.selection.step_values
    operator = metric.operator
    if operator in _ADDED:
        row = step_values(*_ADDED).index(metric.step_value)
        total, count = episode.total[row], episode.count[row]
        mean = total / jnp.maximum(count, 1).astype(jnp.float32)
        return Value(mean if operator == "mean" else total, count > 0)
    if operator in _HIGH:
        value = episode.high[step_values(*_HIGH).index(metric.step_value)]
        return Value((value > 0).astype(jnp.float32) if operator == "any" else value, jnp.isfinite(value))
    if operator in _WORST:
        value = episode.worst[step_values(*_WORST).index(metric.step_value)]
    elif operator == "min":
        value = episode.low[step_values("min").index(metric.step_value)]
    elif operator == "first":
        value = episode.first[step_values("first").index(metric.step_value)]
    else:
        value = episode.last[step_values("last").index(metric.step_value)]
    return Value(value, jnp.isfinite(value))


def event_steps(episode: Episode) -> dict[str, Int[Array, ""]]:
    """Step of the first collision, off-road step and red light, as far as they are selected; -1 for none."""
    return {
        name: jnp.where(episode.event_step[row] == _NEVER, -1, episode.event_step[row])
        for row, name in enumerate(episode.selection.events)
    }
