"""Select metrics by name, and derive the step values and facts that they need."""

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

#: Selection in a configuration: the name of a set, or names of sets, metrics and user-defined metrics.
MetricNames = str | tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MetricSelection:
    """Metrics of a task, cached by :func:`select_metrics`, since compiled programs compare selections by identity.

    Attributes:
        names: The requested metrics.
        metrics: The requested metrics and their inputs, inputs first.
        reads: Facts that their step values read; for the full set all of ``FACTS``, so that planners can read them.
    """

    names: tuple[str, ...]
    metrics: tuple[tuple[str, Metric], ...]
    reads: frozenset[str]

    def step_values(self, *operators: Operator) -> tuple[StepValue, ...]:
        """Return the step values that the operators (all by default) accumulate, without duplicates."""
        metrics = [metric for _, metric in self.metrics if not operators or metric.operator in operators]
        return tuple(dict.fromkeys(metric.step_value for metric in metrics if metric.step_value is not None))

    @property
    def events(self) -> tuple[str, ...]:
        """Events whose first step is stored."""
        return tuple(name for name in EVENTS if name in dict(self.metrics))


@cache
def select_metrics(names: MetricNames) -> MetricSelection:
    """Return the metrics that a configuration names: a set, or a tuple of sets, metrics and dotted names.

    The last word of a dotted name (``package.module:name``) is the name of a user-defined metric. Its inputs are
    catalogue metrics, or user-defined metrics before it in the tuple.

    Raises:
        UsageError: A set, metric or input is unknown, a dotted name is no metric, or two metrics have the same name.
    """
    requested: list[str] = []
    own: dict[str, Metric] = {}
    for entry in (names,) if isinstance(names, str) else dict.fromkeys(names):
        if is_dotted(entry):
            name = entry.rpartition(":")[2].rpartition(".")[2]
            own[name] = _own_metric(entry, name, own)
            requested.append(name)
        elif entry in SETS:
            requested += SETS[entry]
        elif entry in METRICS:
            requested.append(entry)
        else:
            raise UsageError(f"unknown metric {entry!r}", cure=did_you_mean(entry, [*SETS, *METRICS]))
    requested = list(dict.fromkeys(requested))
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


def _own_metric(entry: str, name: str, others: Mapping[str, Metric]) -> Metric:
    metric = find_named(entry)
    if not isinstance(metric, Metric):
        raise UsageError(f"{entry!r} is not a metric", cure="make it a drivax.metrics.catalogue.Metric")
    if name in METRICS or name in others:
        raise UsageError(f"{entry!r}: the metric {name!r} already exists", cure="choose another name")
    for input_name in metric.inputs:
        if input_name not in METRICS and input_name not in others:
            problem = f"{entry!r}: unknown input {input_name!r}"
            raise UsageError(problem, cure=did_you_mean(input_name, [*METRICS, *others]))
    return metric


def _add_with_inputs(name: str, known: Mapping[str, Metric], metrics: dict[str, Metric]) -> None:
    if name not in metrics:
        for input_name in known[name].inputs:
            _add_with_inputs(input_name, known, metrics)
        metrics[name] = known[name]
