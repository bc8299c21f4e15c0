"""How metrics are headed and ordered in a report; what they mean is said where they are defined, in ``metrics``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from drivax.evaluation.results import ADDED, NOT_SUMMARISED, RATES
from drivax.metrics.catalogue import METRICS
from drivax.metrics.catalogue import headline as headline_columns
from drivax.report.loaded_runs import Evaluation

Direction = Literal["up", "down", "none"]


@dataclass(frozen=True)
class Note:
    """How a metric is shown.

    Attributes:
        label: Heading of its column, with the unit where it has one.
        better: Direction of improvement.
        unit: ``rate`` for a share of 0/1 episodes (shown in percent), ``share`` for another number without a unit,
            else the unit.
        explanation: One line; empty for metrics that drivax does not know.
    """

    label: str
    better: Direction
    unit: str
    explanation: str


#: The columns of the first table.
HEADLINE = headline_columns(METRICS)
#: Codes and counts, of which no mean is shown.
CODES = frozenset(NOT_SUMMARISED)
ARROWS = MappingProxyType({"up": "↑", "down": "↓", "none": ""})
_DIRECTIONS: dict[str, Direction] = {"high": "up", "low": "down", "-": "none"}


def note(name: str, runs: Sequence[Evaluation] = ()) -> Note:
    """How to show a metric.

    Args:
        name: Of the metric.
        runs: Evaluations, which say what metrics of the user's own are; one that nobody knows gets its own name and no
            direction.
    """
    ours = METRICS.get(name) or ADDED.get(name)
    metric = ours or next((r.own_metrics[name] for r in runs if name in r.own_metrics), None)
    label = (metric.label if metric else None) or name.replace("_", " ")
    if metric is None:
        return Note(label, "none", "", "")
    plain = metric.unit == "-"
    unit = "rate" if name in RATES else "share" if plain else metric.unit
    heading = label if plain else f"{label} [{metric.unit.replace('s2', 's²').replace('s3', 's³')}]"
    text = metric.definition[:1].upper() + metric.definition[1:]
    return Note(heading, _DIRECTIONS[metric.better], unit, f"{text}.")


def headline(names: Sequence[str]) -> list[str]:
    """Those of these metrics that belong in the first table, in its order."""
    return [name for name in HEADLINE if name in names]


def ordered(names: Sequence[str]) -> list[str]:
    """Metrics in the order in which they are defined, unknown ones after them as given; no codes."""
    place = {name: rank for rank, name in enumerate((*METRICS, *ADDED))}
    return sorted((name for name in names if name not in CODES), key=lambda n: place.get(n, len(place)))
