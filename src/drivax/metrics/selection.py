"""Select metrics by name, and derive what has to be measured and carried for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

from drivax.errors import UsageError, did_you_mean
from drivax.metrics.catalogue import EVENTS, METRICS, SETS, Metric, Operator
from drivax.metrics.steps import StepValue
from drivax.plugins import find_named, is_dotted
from drivax.simulator.types import FACTS

#: A configuration's choice: the name of a set, or names of sets, metrics and the user's own metrics.
MetricNames = str | tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MetricSelection:
    """Metrics that are computed, in order. :func:`select_metrics` caches them: compiled programs compare by identity.

    Attributes:
        names: The requested metrics.
        metrics: These and their inputs, inputs first.
        reads: Facts that their step values read; all facts for the full set, for planners.
    """

    names: tuple[str, ...]
    metrics: tuple[tuple[str, Metric], ...]
    reads: frozenset[str]

    def step_values(self, *operators: Operator) -> tuple[StepValue, ...]:
        """Return the step values that one of these operators (by default any) accumulates, each once."""
        metrics = [m for _, m in self.metrics if not operators or m.operator in operators]
        return tuple({m.step_value: None for m in metrics if m.step_value is not None})

    @property
    def events(self) -> tuple[str, ...]:
        """Events whose first step is stored."""
        return tuple(name for name in EVENTS if name in dict(self.metrics))


@cache
def select_metrics(names: MetricNames) -> MetricSelection:
    """Return the metrics that a configuration names: a set, or a tuple of sets, metrics and dotted names.

    The last word of a dotted name (``package.module:name``) is the name of the user's metric.

    Raises:
        UsageError: There is no such set or metric, or two metrics have the same name.
    """
    requested: dict[str, None] = {}
    own: dict[str, Metric] = {}
    for entry in (names,) if isinstance(names, str) else names:
        if is_dotted(entry):
            name = entry.rpartition(":")[2].rpartition(".")[2]
            own[name] = _own_metric(entry, name, own)
            requested[name] = None
        else:
            requested |= dict.fromkeys(SETS[entry] if entry in SETS else (_check_name(entry),))
    metrics: dict[str, Metric] = {}
    for name in requested:
        _add_with_inputs(name, METRICS | own, metrics)
    values = [metric.step_value for metric in metrics.values() if metric.step_value is not None]
    reads = frozenset[str]().union(*(value.reads for value in values))
    if set(METRICS) <= set(requested):
        reads |= FACTS
    return MetricSelection(tuple(requested), tuple(metrics.items()), reads)


def metric_specs(names: MetricNames) -> Mapping[str, Metric]:
    """Return the specification of each requested metric by name."""
    selection = select_metrics(names)
    specs = dict(selection.metrics)
    return MappingProxyType({name: specs[name] for name in selection.names})


def _check_name(name: str) -> str:
    if name not in METRICS:
        raise UsageError(f"unknown metric {name!r}", cure=did_you_mean(name, [*SETS, *METRICS]))
    return name


def _own_metric(entry: str, name: str, others: Mapping[str, Metric]) -> Metric:
    metric = find_named(entry)
    if not isinstance(metric, Metric):
        raise UsageError(f"{entry!r} is not a metric", cure="make it a drivax.metrics.catalogue.Metric")
    if name in METRICS or name in others:
        raise UsageError(f"{entry!r}: the metric {name!r} already exists", cure="choose another name")
    for needed in metric.inputs:
        if needed not in METRICS and needed not in others:
            raise UsageError(f"{entry!r}: unknown input {needed!r}", cure=did_you_mean(needed, [*METRICS]))
    return metric


def _add_with_inputs(name: str, known: Mapping[str, Metric], metrics: dict[str, Metric]) -> None:
    if name not in metrics:
        for needed in known[name].inputs:
            _add_with_inputs(needed, known, metrics)
        metrics[name] = known[name]
