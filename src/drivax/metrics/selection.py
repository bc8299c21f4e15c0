"""Which metrics are wanted, and what has to be measured and carried for them."""

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

#: What a configuration says: the name of a set, or names of sets, metrics and metrics of the user's own.
Wanted = str | tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Selection:
    """Metrics that are computed, in order. :func:`selected` makes each selection once, and compiled programs go by it.

    Attributes:
        names: What was asked for.
        metrics: These, and whatever they are computed from, inputs first.
        reads: Facts that their step values look at; all of them for the full set, which planners may read too.
    """

    names: tuple[str, ...]
    metrics: tuple[tuple[str, Metric], ...]
    reads: frozenset[str]

    def rows(self, *operators: Operator) -> tuple[StepValue, ...]:
        """Step values that one of these operators accumulates, each once."""
        found = {m.of: None for _, m in self.metrics if m.of is not None and m.operator in operators}
        return tuple(found)

    @property
    def events(self) -> tuple[str, ...]:
        """Events whose first step is kept."""
        return tuple(name for name in EVENTS if name in dict(self.metrics))

    @property
    def values(self) -> tuple[StepValue, ...]:
        """All step values, each once."""
        return tuple({m.of: None for _, m in self.metrics if m.of is not None})


@cache
def selected(wanted: Wanted) -> Selection:
    """The metrics that a configuration asks for.

    Args:
        wanted: ``none``, ``training`` or ``full``; or a tuple of such sets, names of metrics, and dotted names
            (``package.module:name``) of metrics of the user's own, which are called by their last word.

    Raises:
        UsageError: There is no such set or metric, or two of one name.
    """
    entries = (wanted,) if isinstance(wanted, str) else wanted
    names: dict[str, None] = {}
    own: dict[str, Metric] = {}
    for entry in entries:
        if is_dotted(entry):
            name = entry.rpartition(":")[2].rpartition(".")[2]
            own[name] = _own(entry, name, own)
            names[name] = None
        else:
            names |= dict.fromkeys(SETS[entry] if entry in SETS else (_known(entry),))
    closed: dict[str, Metric] = {}
    for name in names:
        _close(name, METRICS | own, closed)
    steps = [m.of for m in closed.values() if m.of is not None]
    reads = frozenset[str]().union(*(s.reads for s in steps))
    if set(METRICS) <= set(names):
        reads |= FACTS
    return Selection(tuple(names), tuple(closed.items()), reads)


def catalogue(wanted: Wanted) -> Mapping[str, Metric]:
    """The metrics that are asked for, by name: units and directions for tables."""
    selection = selected(wanted)
    known = dict(selection.metrics)
    return MappingProxyType({name: known[name] for name in selection.names})


def _known(name: str) -> str:
    if name not in METRICS:
        raise UsageError(f"there is no metric {name!r}", cure=did_you_mean(name, [*SETS, *METRICS]))
    return name


def _own(entry: str, name: str, others: Mapping[str, Metric]) -> Metric:
    found = find_named(entry)
    if not isinstance(found, Metric):
        raise UsageError(f"{entry!r} is no metric", cure="make it a drivax.metrics.catalogue.Metric")
    if name in METRICS or name in others:
        raise UsageError(f"{entry!r}: there is another metric {name!r}", cure="give it another name")
    missing = [one for one in found.inputs if one not in METRICS and one not in others]
    if missing:
        raise UsageError(
            f"{entry!r} is computed from {missing[0]!r}", cure=did_you_mean(missing[0], [*METRICS])
        )
    return found


def _close(name: str, known: Mapping[str, Metric], closed: dict[str, Metric]) -> None:
    """Adds a metric after its inputs."""
    if name not in closed:
        for needed in known[name].inputs:
            _close(needed, known, closed)
        closed[name] = known[name]
