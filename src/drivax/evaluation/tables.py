"""Tables of evaluations: results, differences, kinds of collision, strata, and what was trained where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.evaluation.episode_table import EpisodeTable, ScenarioKey, interval_of
from drivax.evaluation.pairing import Pairs, comparable
from drivax.scenario.select.tags import TAGS
from drivax.simulator.contact import CollisionType
from drivax.stats.intervals import NOTHING, Interval, paired_bootstrap, rate

CONFIDENCE = 0.95
SEED = 0
#: Tags by which results are broken down.
STRATA = ("difficulty", "type", "density")
#: The word of a scenario that lacks a tag.
UNKNOWN = "unknown"
#: What a kind of collision says about the driver: name and reading.
READINGS: Mapping[CollisionType, tuple[str, str]] = MappingProxyType(
    {
        CollisionType.REAR_END: ("rear end", "ran into somebody ahead: distance and braking"),
        CollisionType.REAR_ENDED: ("rear-ended", "was hit from behind: slower than traffic expects, or than the log "
                                   "that traffic replays"),
        CollisionType.SIDE_SWIPE: ("side", "touched somebody beside it or crossing: lane keeping and giving way"),
        CollisionType.HEAD_ON: ("head-on", "met oncoming traffic: left its own side of the road"),
        CollisionType.VULNERABLE: ("pedestrian or cyclist", "hit somebody unprotected: attention to small agents"),
        CollisionType.STOPPED_OBJECT: ("standing object", "ran into somebody who stands: braking in time for a queue"),
    }
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One number of a table: which metric, its interval, and the run behind it where row and column do not say."""

    metric: str
    interval: Interval
    run: str | None = None


@dataclass(frozen=True)
class Row:
    """A row: what it is about, one word per key of the table, and its cells; None where there is nothing to say."""

    labels: tuple[str, ...]
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True)
class Table:
    """Numbers with intervals, for a page or a file.

    Attributes:
        name: Of the file.
        caption: One line.
        keys: Headings of the columns of labels; under ``metric`` stand names of metrics.
        across: What the other columns are: ``metric``, ``planner``, ...
        columns: Headings of the other columns.
        rows: The rows.
        signed: The numbers are differences.
    """

    name: str
    caption: str
    keys: tuple[str, ...]
    across: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    signed: bool = False


def summarise(run: EpisodeTable, metric: str, rows: Any = slice(None)) -> Interval:
    """Mean of a metric over episodes of a run, with the interval that ``summary.json`` gives.

    Episodes of one segment form a cluster. A run without the metric gives an empty interval.

    Args:
        run: The evaluation.
        metric: Name of the metric.
        rows: Which episodes, as an index of an array; all of them by default.
    """
    if metric not in run.metrics:
        return NOTHING
    return interval_of(metric, run.metrics[metric][rows], np.array(run.clusters)[rows])


def paired_difference(run: EpisodeTable, other: EpisodeTable, metric: str) -> Interval:
    """``run - other`` of a metric, scenario by scenario; repeated episodes of a scenario are averaged first."""
    pairs = Pairs.of(run, other)
    mine, theirs = pairs.values(run, metric), pairs.values(other, metric)
    return paired_bootstrap(mine, theirs, pairs.clusters, CONFIDENCE, seed=SEED)


def paired_differences(one: EpisodeTable, other: EpisodeTable, metric: str) -> Interval:
    """:func:`paired_difference` of evaluations on the same scenarios.

    Raises:
        UsageError: They are not the same.
    """
    if set(one.scenarios) != set(other.scenarios):
        raise UsageError("evaluations on different scenarios", cure="evaluate both on one set")
    return paired_difference(one, other, metric)


def results_table(runs: Sequence[EpisodeTable], metrics: Sequence[str]) -> Table:
    """Metrics in rows, runs in columns."""
    rows = tuple(Row((name,), tuple(Cell(name, summarise(run, name)) for run in runs)) for name in metrics)
    caption = f"Mean and {CONFIDENCE:.0%} interval"
    return Table("results", caption, ("metric",), "planner", tuple(run.name for run in runs), rows)


def differences_table(policy: EpisodeTable, others: Sequence[EpisodeTable], metrics: Sequence[str]) -> Table:
    """Metrics in rows, other runs in columns: the policy minus the other, paired by scenario."""
    known = [other for other in others if comparable(policy, other)]
    rows = tuple(
        Row((name,), tuple(Cell(name, paired_difference(policy, other, name)) for other in known))
        for name in metrics
    )
    caption = f"{policy.name} minus the others, paired by scenario, with {CONFIDENCE:.0%} interval"
    names = tuple(one.name for one in known)
    return Table("differences", caption, ("metric",), "against", names, rows, signed=True)


def collisions_table(runs: Sequence[EpisodeTable]) -> Table:
    """Kinds of the first collision in rows, runs in columns: share of the episodes in which they are known."""
    runs = [run for run in runs if "collision_type" in run.metrics]
    known = not any(np.isnan(run.metrics["collision_type"]).any() for run in runs)
    of = "all episodes" if known else "the episodes in which they are known (n)"
    rows = []
    for code, (words, _) in READINGS.items():
        cells = []
        for run in runs:
            kinds = run.metrics["collision_type"]
            found = rate(np.where(np.isnan(kinds), np.nan, kinds == code), run.clusters, CONFIDENCE)
            cells.append(Cell("collision", found))
        rows.append(Row((words,), tuple(cells)))
    caption = f"First collisions by kind: share of {of} with {CONFIDENCE:.0%} interval"
    names = tuple(run.name for run in runs)
    return Table("collisions", caption, ("first collision",), "planner", names, tuple(rows))


def strata_table(
    runs: Sequence[EpisodeTable],
    tags: Mapping[ScenarioKey, Mapping[str, str]],
    tag: str,
    metrics: Sequence[str],
) -> Table:
    """One kind of scenario after the other, each with all runs; metrics in columns.

    Args:
        runs: Evaluations.
        tags: The tags of their scenarios.
        tag: By which one to break down; a scenario without it counts as ``unknown``.
        metrics: Columns.
    """
    words = {run.name: [tags.get(key, {}).get(tag, UNKNOWN) for key in run.scenarios] for run in runs}
    order = {word: place for place, word in enumerate(TAGS.get(tag, ()))}
    values = {word for found in words.values() for word in found}
    rows = []
    for value in sorted(values, key=lambda word: (order.get(word, len(order)), word)):
        for run in runs:
            inside = np.flatnonzero(np.array(words[run.name]) == value)
            if inside.size:
                cells = tuple(Cell(name, summarise(run, name, inside)) for name in metrics)
                rows.append(Row((value, run.name), cells))
    caption = f"By {tag}: mean and {CONFIDENCE:.0%} interval"
    return Table(f"by-{tag}", caption, (tag, "planner"), "metric", tuple(metrics), tuple(rows))


def set_names(runs: Sequence[EpisodeTable]) -> dict[str, str]:
    """Names of all data sets that runs drove or were trained on, by their key: unique, as short as may be."""
    entries = {_set_key(entry): entry for run in runs for entry in (run.data, *_trained_on(run))}
    named = {key: _set_name(entry) for key, entry in entries.items()}
    names = list(named.values())
    return {key: name if names.count(name) == 1 else f"{name} {key[:6]}" for key, name in named.items()}


def _trained_on(run: EpisodeTable) -> Sequence[Mapping[str, Any]]:
    return run.info.get("trained_on") or ()


def _set_key(entry: Mapping[str, Any]) -> str:
    return str(entry.get("hash") or entry.get("path") or "unknown")


def _set_name(entry: Mapping[str, Any]) -> str:
    path = entry.get("path")
    return str(entry.get("name") or (Path(str(path)).name if path else _set_key(entry)[:12]))


def _planner_key(run: EpisodeTable) -> str:
    """Who drove: what the command called it, or else the planner's name."""
    return str(run.settings.get("planner") or run.planner)


def _planner_names(runs: Sequence[EpisodeTable]) -> dict[str, str]:
    """A name for each planner by its key: its own, or where two share that, as much of their paths as it takes."""
    own = {_planner_key(run): str(run.planner) for run in runs}
    named = {}
    for key, name in own.items():
        paths = [Path(other).parts for other in own if other != key and own[other] == name]
        parts = Path(key).parts
        take = next(
            (n for n in range(1, len(parts)) if all(parts[-n:] != path[-n:] for path in paths)), len(parts)
        )
        named[key] = "/".join(parts[-take:]) if paths else name
    return named


def transfer_table(runs: Sequence[EpisodeTable], metric: str) -> Table:
    """What was trained in rows, what was driven in columns: a metric of every pair that was evaluated.

    A planner is who the command named, so that policies of one name (``bc/seed-0`` and ``ppo/seed-0``) stay apart.
    Where the same one drove one set more than once (from other starts, say), each run has a row of its own.
    """
    planners = _planner_names(runs)
    names = set_names(runs)
    driven = [names[_set_key(run.data)] for run in runs]
    found: dict[tuple[str, ...], dict[str, Cell]] = {}
    for run, where in zip(runs, driven, strict=True):
        trained = ", ".join(names[_set_key(entry)] for entry in _trained_on(run)) or "–"
        labels = (planners[_planner_key(run)], trained, run.traffic)
        if where in found.get(labels, {}):
            labels = (run.name, *labels[1:])
        found.setdefault(labels, {})[where] = Cell(metric, summarise(run, metric), run.name)
    columns = tuple(dict.fromkeys(driven))
    rows = tuple(Row(labels, tuple(cells.get(name) for name in columns)) for labels, cells in found.items())
    caption = f"By training and evaluation data: mean and {CONFIDENCE:.0%} interval"
    keys = ("planner", "trained on", "traffic")
    return Table(f"transfer-{metric}", caption, keys, "evaluated on", columns, rows)
