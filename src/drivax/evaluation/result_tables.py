"""Tables of evaluations: results, differences, collision types, strata, and transfer between data sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from drivax.evaluation.episode_table import COLUMNS, NOT_SUMMARISED, RATES, EpisodeTable, Tags, interval_of
from drivax.evaluation.pairing import Pairs, mismatch
from drivax.files import path_end
from drivax.metrics.catalogue import METRICS, headline
from drivax.scenario.select.tags import TAGS
from drivax.simulator.contact import CollisionType
from drivax.stats.intervals import UNDEFINED, Interval, paired_bootstrap, rate
from drivax.table import Cell, Column, Table, interval_cell

CONFIDENCE = 0.95
SEED = 0
#: Tags for breakdowns of the results.
STRATA = ("difficulty", "type", "density", "scenario_types")
#: Tag value of scenarios without the tag.
UNKNOWN = "unknown"
#: Name and typical cause of each collision type.
COLLISION_KINDS: Mapping[CollisionType, tuple[str, str]] = MappingProxyType(
    {
        CollisionType.REAR_END: ("rear end", "hit the agent ahead: distance and braking"),
        CollisionType.REAR_ENDED: ("rear-ended", "was hit from behind: slower than traffic expects, or than the log "
                                   "that traffic replays"),
        CollisionType.SIDE_SWIPE: ("side", "touched an agent at its side or crossing: lane keeping and giving way"),
        CollisionType.HEAD_ON: ("head-on", "met oncoming traffic: left its own side of the road"),
        CollisionType.VULNERABLE: ("pedestrian or cyclist", "hit an unprotected agent: attention to small agents"),
        CollisionType.STOPPED_OBJECT: ("standing object", "hit a standing agent: braking in time for a queue"),
    }
)  # fmt: skip
_ARROWS = {"high": " ↑", "low": " ↓", "-": ""}


@dataclass(frozen=True)
class MetricLabel:
    """Presentation of a metric: label with unit, better direction (``-`` for none), unit, and explanation.

    The unit is ``rate`` for built-in shares of episodes, and ``share`` for other numbers without a unit. An unknown
    metric has no unit and no explanation.
    """

    text: str
    better: str
    unit: str
    explanation: str

    @property
    def heading(self) -> str:
        """The label with an arrow in the better direction."""
        return self.text + _ARROWS[self.better]

    @property
    def title(self) -> str:
        """The explanation with the better direction."""
        direction = {"high": "Higher is better.", "low": "Lower is better.", "-": ""}[self.better]
        return f"{self.explanation} {direction}".strip()


def metric_label(name: str, runs: Sequence[EpisodeTable] = ()) -> MetricLabel:
    """Return the label of a metric; ``runs`` describe user-defined metrics."""
    user_columns = (run.own_metrics[name] for run in runs if name in run.own_metrics)
    metric = COLUMNS.get(name) or next(user_columns, None)
    if metric is None:
        return MetricLabel(name.replace("_", " "), "-", "", "")
    text = metric.label or name.replace("_", " ")
    has_no_unit = metric.unit == "-"
    if not has_no_unit:
        text = f"{text} [{metric.unit.replace('s2', 's²').replace('s3', 's³')}]"
    unit = "rate" if name in RATES else "share" if has_no_unit else metric.unit
    return MetricLabel(text, metric.better, unit, f"{metric.definition[:1].upper()}{metric.definition[1:]}.")


def metric_names(runs: Sequence[EpisodeTable]) -> list[str]:
    """Return the metrics of all runs without duplicates, in the order of first appearance."""
    return list(dict.fromkeys(name for run in runs for name in run.metrics))


def headline_names(names: Sequence[str]) -> list[str]:
    """Return the headline metrics among ``names``, in headline order."""
    return [name for name in headline(METRICS) if name in names]


def sort_metrics(names: Sequence[str]) -> list[str]:
    """Sort metrics in the order of their definition, unknown metrics last, and drop codes and counts."""
    rank = {name: index for index, name in enumerate(COLUMNS)}
    summarised_names = (name for name in names if name not in NOT_SUMMARISED)
    return sorted(summarised_names, key=lambda name: rank.get(name, len(rank)))


def summarise(run: EpisodeTable, metric: str, rows: Any = slice(None)) -> Interval:
    """Return the mean of a metric over the episodes ``rows``, with its interval as in ``summary.json``.

    The result is undefined if the evaluation lacks the metric.
    """
    if metric not in run.metrics:
        return UNDEFINED
    return interval_of(metric, run.metrics[metric][rows], np.array(run.clusters)[rows])


def paired_difference(run: EpisodeTable, other: EpisodeTable, metric: str) -> Interval:
    """Return ``run - other`` of a metric, paired by scenario; repeated episodes are averaged first."""
    pairs = Pairs.of(run, other)
    values, other_values = pairs.values(run, metric), pairs.values(other, metric)
    return paired_bootstrap(values, other_values, pairs.clusters, CONFIDENCE, seed=SEED)


def difference(run: EpisodeTable, other: EpisodeTable, metric: str) -> tuple[Interval, str]:
    """Return the paired difference ``run - other`` of a metric with its verdict.

    The verdict is ``better``, ``worse``, ``unclear`` (the interval contains 0), ``same`` (all differences are 0) or
    ``none`` (no better direction, or no interval).
    """
    interval = paired_difference(run, other, metric)
    return interval, _verdict(interval, metric_label(metric, [run]).better)


def _verdict(interval: Interval, better: str) -> str:
    low, high = interval.low, interval.high
    if better == "-" or low is None or high is None:
        return "none"
    if low == high == 0:
        return "same"
    if low <= 0 <= high:
        return "unclear"
    return "better" if (low > 0) == (better == "high") else "worse"


def planners_table(runs: Sequence[EpisodeTable], metrics: Sequence[str]) -> Table:
    """Return a table with planners in rows and metrics in columns; the best mean of each column is marked."""
    column_cells = [[Cell(run.name, note=f"{len(run)} episodes, {run.traffic} traffic") for run in runs]]
    for name in metrics:
        means = [summarise(run, name) for run in runs]
        best_mean = _best_mean(means, metric_label(name, runs))
        links = ({"run": run.name, "metric": name} for run in runs)
        column_cells.append([_cell(runs, name, *pair, best_mean) for pair in zip(means, links, strict=True)])
    columns = (Column("planner", label=True), *_metric_columns(metrics, runs))
    return Table("planners", columns, tuple(zip(*column_cells, strict=True)))


def _best_mean(intervals: Sequence[Interval], label: MetricLabel) -> float | None:
    """Return the best mean of a column; None if all means are equal or the metric has no better direction."""
    means = [interval.mean for interval in intervals if interval.mean is not None]
    if label.better == "-" or len(means) < 2 or min(means) == max(means):
        return None
    return max(means) if label.better == "high" else min(means)


def _cell(
    runs: Sequence[EpisodeTable], metric: str, interval: Interval, link: Mapping[str, Any],
    best_mean: float | None = None,
) -> Cell:  # fmt: skip
    if interval.mean is None:
        return interval_cell(interval, "", metric)
    style = "best" if best_mean is not None and interval.mean == best_mean else ""
    return interval_cell(interval, metric_label(metric, runs).unit, metric, style=style, link=link)


def _metric_columns(metrics: Sequence[str], runs: Sequence[EpisodeTable]) -> list[Column]:
    labels = [(name, metric_label(name, runs)) for name in metrics]
    return [Column(label.heading, name, title=label.title or name) for name, label in labels]


def _metric_cell(metric: str, runs: Sequence[EpisodeTable]) -> Cell:
    label = metric_label(metric, runs)
    return Cell(label.heading, metric=metric, title=label.title or metric)


def results_table(runs: Sequence[EpisodeTable], metrics: Sequence[str]) -> Table:
    """Return a table with metrics in rows and runs in columns."""
    rows = []
    for name in metrics:
        cells = (_cell(runs, name, summarise(run, name), {"run": run.name, "metric": name}) for run in runs)
        rows.append((_metric_cell(name, runs), *cells))
    columns = (Column("metric", "metric", label=True), *(Column(run.name, run.name) for run in runs))
    return Table("results", columns, tuple(rows), f"Mean and {CONFIDENCE:.0%} interval", "planner")


#: Text of each verdict; the symbol makes it readable without colour.
_MARKS = {"better": "▲ better", "worse": "▼ worse", "unclear": "unclear", "same": "= same", "none": ""}


def differences_table(policy: EpisodeTable, others: Sequence[EpisodeTable], metrics: Sequence[str]) -> Table:
    """Return a table with metrics in rows and other runs in columns.

    Entries are differences between the policy and the other run, paired by scenario.
    """
    rows = tuple(
        (_metric_cell(name, [policy]), *(_difference_cell(policy, other, name) for other in others))
        for name in metrics
    )
    caption = f"{policy.name} minus the others, paired by scenario, with {CONFIDENCE:.0%} interval"
    columns = (Column("metric", "metric", label=True), *(Column(run.name, run.name) for run in others))
    return Table("differences", columns, rows, caption, "against")


def _difference_cell(policy: EpisodeTable, other: EpisodeTable, metric: str) -> Cell:
    if problem := mismatch(policy, other):
        return Cell(f"no pairs: {problem[0]}", style="undefined")
    interval, verdict = difference(policy, other, metric)
    if interval.mean is None:
        return interval_cell(interval, "", metric, signed=True, title="no scenario where both are defined")
    style = {"style": verdict, "mark": _MARKS[verdict], "link": {"run": policy.name, "metric": metric}}
    return interval_cell(interval, metric_label(metric, [policy]).unit, metric, signed=True, **style)


def collisions_table(runs: Sequence[EpisodeTable]) -> Table:
    """Return a table with types of the first collision in rows and runs in columns.

    Shares are of the episodes with a known type. Runs without types have no column.
    """
    runs = [run for run in runs if "collision_type" in run.metrics]
    all_known = not any(np.isnan(run.metrics["collision_type"]).any() for run in runs)
    population = "all episodes" if all_known else "the episodes with a known type (n)"
    rows = []
    for code, (name, _) in COLLISION_KINDS.items():
        cells = []
        for run in runs:
            types = run.metrics["collision_type"]
            share = rate(np.where(np.isnan(types), np.nan, types == code), run.clusters, CONFIDENCE)
            cells.append(_cell(runs, "collision", share, {"run": run.name, "kind": int(code)}))
        rows.append((Cell(name), *cells))
    caption = f"First collisions by type: share of {population} with {CONFIDENCE:.0%} interval"
    columns = (Column("first collision", label=True), *(Column(run.name, run.name) for run in runs))
    return Table("collisions", columns, tuple(rows), caption, "planner")


def strata_table(runs: Sequence[EpisodeTable], tags: Tags, tag: str, metrics: Sequence[str]) -> Table:
    """Return a table with a row for each value of a tag and run, and metrics in columns.

    Scenarios without the tag have the value ``unknown``. A scenario with several values, separated by ``|``
    (``scenario_types``), counts in the row of each.
    """
    all_values = [[tags.get(key, {}).get(tag, UNKNOWN).split("|") for key in run.scenarios] for run in runs]
    rank = {value: index for index, value in enumerate(TAGS.get(tag, ()))}
    values = {value for run_values in all_values for episode_values in run_values for value in episode_values}
    rows = []
    for value in sorted(values, key=lambda value: (rank.get(value, len(rank)), value)):
        for run, run_values in zip(runs, all_values, strict=True):
            episodes = np.flatnonzero([value in episode_values for episode_values in run_values])
            if episodes.size:
                link = {"run": run.name, "tags": {tag: value}}
                means = ((name, summarise(run, name, episodes)) for name in metrics)
                cells = (_cell(runs, name, mean, link | {"metric": name}) for name, mean in means)
                rows.append((Cell(value), Cell(run.name), *cells))
    caption = f"By {tag}: mean and {CONFIDENCE:.0%} interval"
    labels = (Column(tag, label=True), Column("planner", label=True))
    return Table(f"by-{tag}", (*labels, *_metric_columns(metrics, runs)), tuple(rows), caption)


def set_names(runs: Sequence[EpisodeTable]) -> dict[str, str]:
    """Return unique short names of the data sets of runs (evaluation and training), by :func:`set_key`."""
    entries = {
        set_key(entry): entry for run in runs for entry in (run.data, *(run.info.get("trained_on") or ()))
    }
    short_names = {key: _set_name(entry) for key, entry in entries.items()}
    names = list(short_names.values())
    # Without a hash the key is a path, whose first characters may be those of another set's path.
    suffixes = {key: key[:6] if entry.get("hash") else f"({key})" for key, entry in entries.items()}
    return {
        key: name if names.count(name) == 1 else f"{name} {suffixes[key]}"
        for key, name in short_names.items()
    }


def set_key(entry: Mapping[str, Any]) -> str:
    """Return the identifier of a data set: its hash, or else its path."""
    return str(entry.get("hash") or entry.get("path") or "unknown")


def _set_name(entry: Mapping[str, Any]) -> str:
    path = entry.get("path")
    return str(entry.get("name") or (Path(str(path)).name if path else set_key(entry)[:12]))


def _planner_key(run: EpisodeTable) -> str:
    """Return the planner as named on the command line, or else its own name."""
    return str(run.settings.get("planner") or run.planner)


def _planner_names(runs: Sequence[EpisodeTable]) -> dict[str, str]:
    """Return the name of each planner by its key; planners of one name have the shortest unique ends of their paths."""
    name_by_key = {_planner_key(run): run.planner for run in runs}
    names = {}
    for key, name in name_by_key.items():
        namesakes = [Path(other) for other in name_by_key if other != key and name_by_key[other] == name]
        names[key] = path_end(Path(key), namesakes) if namesakes else name
    return names


def transfer_table(runs: Sequence[EpisodeTable], metric: str) -> Table:
    """Return a table of a metric with training data in rows and evaluation data in columns.

    A planner is identified by its command-line name (``bc/seed-0`` and ``ppo/seed-0`` are different planners). Several
    runs of a planner on the same set, for example with different starts, have separate rows.
    """
    planners, names = _planner_names(runs), set_names(runs)
    evaluation_sets = [names[set_key(run.data)] for run in runs]
    cells: dict[tuple[str, ...], dict[str, Cell]] = {}
    for run, set_name in zip(runs, evaluation_sets, strict=True):
        training_sets = ", ".join(names[set_key(entry)] for entry in run.info.get("trained_on") or ()) or "–"
        labels = (planners[_planner_key(run)], training_sets, run.traffic)
        if set_name in cells.get(labels, {}):
            labels = (run.name, *labels[1:])
        link = {"run": run.name, "metric": metric}
        cells.setdefault(labels, {})[set_name] = _cell(runs, metric, summarise(run, metric), link)
    sets = tuple(dict.fromkeys(evaluation_sets))
    rows = tuple(
        (*map(Cell, labels), *(cell_by_set.get(name, Cell(style="undefined")) for name in sets))
        for labels, cell_by_set in cells.items()
    )
    headings = [Column(key, label=True) for key in ("planner", "trained on", "traffic")]
    columns = (*headings, *(Column(name, name) for name in sets))
    caption = f"By training and evaluation data: mean and {CONFIDENCE:.0%} interval"
    return Table(f"transfer-{metric}", columns, rows, caption, "evaluated on")
