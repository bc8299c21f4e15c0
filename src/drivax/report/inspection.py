"""Contents of scenario sets as numbers, and the tables of ``drivax inspect``: one set, or several side by side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import groupby
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.evaluation.observation_statistics import FeatureStatistics, ObservationStatistics
from drivax.files import path_end
from drivax.report.charts import format_short
from drivax.scenario.schema import DT_S, NAMES, AgentKind, Scenario
from drivax.scenario.select.selection import FINDINGS, Selection, tag_words
from drivax.scenario.store import ScenarioSet
from drivax.stats.clusters import recordings_of
from drivax.table import MISSING, Cell, Column, Table

Array = np.ndarray[Any, Any]
Entry = Mapping[str, Any]

_SOURCE = ("steps", "tracks", "tracks_valid_now", "map_features", "map_points", "lights", "lost")
#: Maximum number of scenarios whose records are read for speeds and rates.
SAMPLE = 1000


@dataclass(frozen=True)
class Inspection:
    """A scenario set and the rows of its selected scenarios (at least one).

    ``unknown`` counts the scenarios without the value of a filter, by filter; ``checked`` is True if all checksums were
    tested.
    """

    name: str
    scenarios: ScenarioSet
    rows: tuple[int, ...]
    unknown: Mapping[str, int]
    checked: bool

    @classmethod
    def open(cls, path: Path, selection: Selection, check: bool = True) -> Inspection:
        """Open a set, and with ``check`` read all of it and test every checksum.

        Raises:
            DataError: The set is damaged, or no scenario is selected.
        """
        scenarios = ScenarioSet.open(path, verify=check)
        if check:
            scenarios.check()
        rows, unknown = tuple(selection.rows(scenarios.entries)), selection.unknown(scenarios.entries)
        if not rows:
            text = " and ".join(condition.text for condition in selection.filters)
            missing = ", ".join(f"{count:,} lack the value of {name!r}" for name, count in unknown.items())
            suffix = f" ({missing})" if missing else ""
            problem = f"none of {len(scenarios):,} scenarios has {text}{suffix}"
            cure = "list the values with drivax inspect without --filter"
            raise DataError(problem, file=path, cure=cure)
        return cls(path.resolve().name, scenarios, rows, unknown, check)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def entries(self) -> list[Entry]:
        """The manifest entries of the selected scenarios."""
        return [self.scenarios.entries[row] for row in self.rows]

    def describe(self) -> list[dict[str, Any]]:
        """Return the selected scenarios as ``inspect --json`` prints them, in a stable format.

        ``origin`` is the origin of a scenario's coordinates in the map frame of its source: x, y, z in metres.
        """
        return [
            {
                **{name: entry[name] for name in NAMES},
                **{name: entry["source"][name] for name in _SOURCE},
                **{name: entry[name] for name in ("segments", "overflow", "flags", "audit")},
                "origin": self.scenarios[row].origin.tolist(),
            }
            for row, entry in zip(self.rows, self.entries, strict=True)
        ]

    @property
    def source(self) -> Mapping[str, Any]:
        """Provenance of the set, with the records read and skipped; empty for handmade sets."""
        return self.scenarios.manifest["source"]

    def sample(self, maximum: int | None = None) -> Iterator[Scenario]:
        """Return at most ``maximum`` (default ``SAMPLE``) selected scenarios at evenly spaced rows."""
        maximum = SAMPLE if maximum is None else maximum
        indices = np.unique(np.linspace(0, len(self.rows) - 1, min(maximum, len(self.rows))).round())
        return (self.scenarios[self.rows[int(index)]] for index in indices)

    @property
    def hours(self) -> float:
        """Driving time of the selected scenarios; overlapping windows of one recording count in full."""
        return sum(max(entry["source"]["steps"] - 1, 0) for entry in self.entries) * DT_S / 3600

    @property
    def recordings(self) -> int:
        """Number of distinct recordings; scenarios of unknown recordings count as one each."""
        return len(set(recordings_of(self.entries)))

    @property
    def megabytes(self) -> float:
        """Size of the whole set on disk, MB, whatever scenarios are selected."""
        files = (path for path in self.scenarios.path.rglob("*") if path.is_file())
        return sum(path.stat().st_size for path in files) / 1e6

    def rate_hz(self) -> tuple[float, float]:
        """Return the smallest and largest rate of the sampled scenarios, Hz."""
        rates = [1.0 / float(scenario.record["dt_s"]) for scenario in self.sample()]
        return min(rates), max(rates)

    def values(self, read: Callable[[Entry], Any]) -> Float[Array, " known"]:
        """Return a quantity of the scenarios that define it."""
        numbers = (read(entry) for entry in self.entries)
        return np.array([number for number in numbers if number is not None], np.float64)

    def value_counts(self, read: Callable[[Entry], Sequence[str]]) -> dict[str, int]:
        """Return the number of scenarios with each value, the most frequent first."""
        counts = Counter(value for entry in self.entries for value in read(entry))
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def tags(self) -> dict[str, dict[str, int]]:
        """Return the number of scenarios with each value of each tag except the data set."""
        names = self.value_counts(lambda entry: [name for name in entry["tags"] if name != "dataset"])
        return {name: self.value_counts(lambda e, name=name: sorted(tag_words(e, name))) for name in names}

    def totals(self, read: Callable[[Entry], Mapping[str, int]]) -> dict[str, tuple[int, int]]:
        """Return the sum of each counter, and the number of scenarios where it is not zero."""
        counts, scenarios = Counter[str](), Counter[str]()
        for entry in self.entries:
            nonzero = {name: number for name, number in read(entry).items() if number}
            counts.update(nonzero)
            scenarios.update(nonzero.keys())
        return {name: (counts[name], scenarios[name]) for name in sorted(counts)}

    def findings(self) -> list[str]:
        """Return the names of the audit's defined findings: those of ``FINDINGS`` in its order, then others by name."""
        names = {name for e in self.entries for name, value in e["audit"].items() if value is not None}
        return [*(name for name in FINDINGS if name in names), *sorted(names - set(FINDINGS))]

    def finding(self, name: str) -> list[Any]:
        """Return a finding of the audit for every scenario that has it."""
        values = (entry["audit"].get(name) for entry in self.entries)
        return [value for value in values if value is not None]


@dataclass(frozen=True)
class Quantity:
    """A quantity of scenarios in tables and histograms; ``read`` returns its value from a manifest entry."""

    label: str
    unit: str
    read: Callable[[Entry], Any]

    @classmethod
    def of(cls, label: str, *keys: str, unit: str = "", default: int | None = None) -> Quantity:
        """Return the quantity at nested keys of an entry, ``default`` if the last key is missing."""
        *path, name = keys
        return cls(label, unit, lambda entry: reduce(getitem, path, entry).get(name, default))


#: Counts of a scenario's source before cropping and capping, its number of stored segments, and findings of its audit.
QUANTITIES = (
    Quantity.of("agents now", "source", "tracks_valid_now"),
    Quantity.of("tracks", "source", "tracks"),
    Quantity.of("steps", "source", "steps"),
    *(
        Quantity.of(f"{name.replace('_', ' ')}s", "source", "map_features", name, default=0)
        for name in ("lane", "road_line", "road_edge", "crosswalk", "stop_sign")
    ),
    Quantity.of("map points", "source", "map_points"),
    Quantity.of("stored segments", "segments"),
    Quantity.of("lights", "source", "lights"),
    Quantity.of("ego drives", "audit", "distance_m", unit="m"),
    Quantity.of("log to route, mean", "audit", "route_deviation_mean_m", unit="m"),
    Quantity.of("log to route, most", "audit", "route_deviation_max_m", unit="m"),
)


@dataclass(frozen=True)
class Speeds:
    """Speeds in ``scenarios`` sampled scenarios, m/s: ego at every logged step, other vehicles at the current step."""

    ego: Float[Array, " step"]
    vehicles: Float[Array, " vehicle"]
    scenarios: int


def read_speeds(inspection: Inspection) -> Speeds:
    """Read speeds from the records of a sample."""
    ego, vehicles = [], []
    for scenario in inspection.sample():
        speed = np.linalg.norm(scenario.agent_velocity, axis=-1)
        valid, now = scenario.agent_valid, int(scenario.current_step)
        ego.append(speed[valid[:, 0], 0])
        others = valid[now, 1:] & (scenario.agent_kind[1:] == AgentKind.VEHICLE)
        vehicles.append(speed[now, 1:][others])
    ego_mps, vehicles_mps = (np.concatenate(values, dtype=np.float64) for values in (ego, vehicles))
    return Speeds(ego_mps, vehicles_mps, len(ego))


#: Maximum numbers of listed scenarios, sets per table, and causes of unreadable records.
MAX_LISTED, SETS_PER_TABLE, _MAX_CAUSES = 30, 4, 3
#: Maximum numbers of listed values of a tag or flag, and of places of a set.
_MAX_VALUES, _MAX_PLACES = 12, 6
#: A label and one text per set.
Row = tuple[str, list[str]]


def overview(inspection: Inspection) -> Table:
    """Return the facts of a set: counts, size, tags, flags, overflow."""
    scenarios, count = inspection.scenarios, len(inspection)
    manifest, capacity = scenarios.manifest, scenarios.capacity
    segments_text = f"recorded segments: {inspection.recordings:,}, shards: {len(manifest['shards']):,}"
    rows = [("set", str(scenarios.path)), ("scenarios", f"{_count_text(inspection)} ({segments_text})")]
    unknown = inspection.unknown.items()
    rows += [("", f"{missing:,} lack the value of {name!r} and are left out") for name, missing in unknown]
    size_text = f"{inspection.megabytes:,.1f} MB, {manifest['record_bytes'] / 1e3:,.0f} kB per scenario"
    capacity_text = (
        f"{capacity.name}: {capacity.agents} moving and {capacity.parked} parked agents, {capacity.segments:,} map "
        f"segments, {capacity.lanes} lanes, {capacity.lights} lights"
    )
    rows += [
        ("data sets", _counts_text(inspection.value_counts(lambda entry: [entry["dataset"]]), count)),
        ("duration", f"{_hours_text(inspection)} at {_rate_text(inspection)}"),
        ("size", size_text),
        ("capacity", capacity_text),
        ("written by", f"drivax {manifest['drivax_version']}, schema {manifest['schema_version']}"),
        *_skipped_rows(inspection.source),
        *((name, _counts_text(values, count)) for name, values in inspection.tags().items()),
        ("flags", _counts_text(inspection.value_counts(lambda entry: entry["flags"]), count)),
        ("did not fit", _totals_text(inspection.totals(lambda entry: entry["overflow"]))),
        ("left out", _totals_text(inspection.totals(lambda entry: entry["source"].get("lost", {})))),
        ("integrity", "all checksums match" if inspection.checked else "not tested (--no-check)"),
    ]
    return _table("overview", ["", ""], [(label, [text]) for label, text in rows], left=True)


def _skipped_rows(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the numbers of records that a conversion skipped or filtered, and the first causes."""
    records, filter_count = source.get("skipped_records", []), source.get("filtered", 0)
    if records:
        yield (
            "skipped",
            f"{len(records):,} record{'s' if len(records) > 1 else ''} that could not be converted",
        )
    for entry in records[:_MAX_CAUSES]:
        record = "" if entry["record"] is None else f"record {entry['record']}: "
        yield "", f"{entry['file']}: {record}{entry['problem']}"
    if len(records) > _MAX_CAUSES:
        yield "", f"{len(records) - _MAX_CAUSES:,} more in manifest.json"
    if filter_count:
        filters = " and ".join(source["filters"])
        yield "filtered", f"{filter_count:,} scenario{'s' if filter_count > 1 else ''} left out by {filters}"


def audit_table(inspection: Inspection) -> Table | None:
    """Return the findings of the log replay, or None if no scenario was audited."""
    names = inspection.findings()
    if not names:
        return None
    columns = (Column("audit", label=True), Column("found", left=True), Column("n"))
    findings = {name: inspection.finding(name) for name in names}
    rows = ((name, finding_text(values), f"{len(values):,}") for name, values in findings.items())
    return Table("audit", columns, tuple(tuple(map(Cell, row)) for row in rows))


def finding_text(values: Sequence[Any]) -> str:
    """Format booleans as a count, numbers as mean, median and maximum, and text values as counts."""
    if not values:
        return MISSING
    if all(isinstance(value, bool) for value in values):
        return f"{sum(values):,} of {len(values):,} ({_percent(sum(values), len(values))})"
    if all(isinstance(value, str) for value in values):
        return _counts_text({value: values.count(value) for value in sorted(set(values))}, len(values))
    numbers = np.array(values, np.float64)
    mean, median, largest = map(format_short, (numbers.mean(), np.median(numbers), numbers.max()))
    return f"mean {mean}, median {median}, max {largest}"


def scenarios_table(inspection: Inspection) -> Table:
    """Return the first scenarios with the counts of their source."""
    names = ("steps", "tracks", "now", "lanes", "lines", "edges", "others", "points", "lights", "segments")
    columns = (Column("scenario", label=True, max_width=24), *map(Column, names))
    entries = inspection.entries[:MAX_LISTED]
    rows = ((entry["scenario_id"], *(f"{count:,}" for count in _counts(entry))) for entry in entries)
    return Table("scenarios", columns, tuple(tuple(map(Cell, row)) for row in rows))


def _counts(entry: Entry) -> tuple[int, ...]:
    """Return the counts of a scenario in the order of the columns of :func:`scenarios_table`."""
    source, features = entry["source"], entry["source"]["map_features"]
    track_counts = [source[name] for name in ("steps", "tracks", "tracks_valid_now")]
    feature_counts = [features.get(name, 0) for name in ("lane", "road_line", "road_edge")]
    others = sum(features.values()) - sum(feature_counts)
    return (*track_counts, *feature_counts, others, source["map_points"], source["lights"], entry["segments"])


def with_distinct_names(inspections: Sequence[Inspection]) -> list[Inspection]:
    """Return the sets, those that share a name renamed to the shortest ends of their paths that distinguish them."""
    paths = [inspection.scenarios.path.resolve() for inspection in inspections]
    others = [[other for other in paths if other.name == path.name and other != path] for path in paths]
    triples = zip(inspections, paths, others, strict=True)
    return [replace(inspection, name=path_end(path, namesakes)) for inspection, path, namesakes in triples]


def comparison(inspections: Sequence[Inspection]) -> list[Table]:
    """Return tables of at most four sets: sizes, averages per scenario, shares of audit findings, tags and flags."""
    inspections = with_distinct_names(inspections)
    groups = [
        inspections[first : first + SETS_PER_TABLE] for first in range(0, len(inspections), SETS_PER_TABLE)
    ]
    return [content_table(group, _share_rows(group), max_width=24) for group in groups]


def content_table(inspections: Sequence[Inspection], extra: Sequence[Row] = (), **options: Any) -> Table:
    """Return sizes of sets and averages of their scenarios, one column per set."""
    rows: list[Row] = [
        (label, [text(inspection) for inspection in inspections]) for label, text in _CONTENT.items()
    ]
    for quantity in QUANTITIES:
        values_by_set = [inspection.values(quantity.read) for inspection in inspections]
        label = f"{quantity.label}, {quantity.unit}" if quantity.unit else quantity.label
        rows.append(
            (label, [format_short(values.mean()) if len(values) else MISSING for values in values_by_set])
        )
    names = ["", *(inspection.name for inspection in inspections)]
    return _table("sets", names, [*rows, *extra], **options)


#: Rows of :func:`content_table` before the quantities.
_CONTENT: Mapping[str, Callable[[Inspection], str]] = {
    "scenarios": lambda inspection: _count_text(inspection),
    "recordings": lambda inspection: f"{inspection.recordings:,}",
    "data sets": lambda inspection: ", ".join(inspection.value_counts(lambda entry: [entry["dataset"]])),
    "places": lambda inspection: _places_text(inspection),
    "duration": lambda inspection: _hours_text(inspection),
    "rate": lambda inspection: _rate_text(inspection),
    "skipped": lambda inspection: f"{inspection.source.get('skipped', 0):,}",
    "MB": lambda inspection: f"{inspection.megabytes:,.1f}",
}


def _table(name: str, headings: Sequence[str], rows: Sequence[Row], **options: Any) -> Table:
    """Return a table of texts with a label column; ``options`` are those of the other columns."""
    columns = (Column(headings[0], label=True), *(Column(heading, **options) for heading in headings[1:]))
    return Table(name, columns, tuple((Cell(label), *map(Cell, texts)) for label, texts in rows))


def _share_rows(inspections: Sequence[Inspection]) -> list[Row]:
    """Return the shares of scenarios by audit finding, tag value and flag.

    Tags of more than :data:`_MAX_VALUES` values have the number of their values instead; ``place`` is in
    :data:`_CONTENT`.
    """
    sizes = [len(inspection) for inspection in inspections]
    rows = _percents("", true_findings(inspections))
    tags_by_set = [inspection.tags() for inspection in inspections]
    for name in dict.fromkeys(name for tags in tags_by_set for name in tags if name != "place"):
        counts = [tags.get(name, {}) for tags in tags_by_set]
        shares = with_sizes(counts, sizes)
        if len(shares) > _MAX_VALUES:
            rows.append((name, [f"{len(values):,} values" if values else MISSING for values in counts]))
        else:
            rows += _percents(f"{name} ", shares)
    flags = [inspection.value_counts(lambda entry: entry["flags"]) for inspection in inspections]
    return rows + _percents("flag ", with_sizes(flags, sizes))


#: Per value, (count, total) in each set.
Counts = dict[str, list[tuple[int, int]]]


def true_findings(inspections: Sequence[Inspection]) -> Counts:
    """Return the number of scenarios with each boolean finding of the audit, of those where it is defined."""
    findings = {}
    for name in dict.fromkeys(name for inspection in inspections for name in inspection.findings()):
        values_by_set = [inspection.finding(name) for inspection in inspections]
        if any(isinstance(value, bool) for values in values_by_set for value in values):
            findings[name] = [(sum(map(bool, values)), len(values)) for values in values_by_set]
    return findings


def with_sizes(counts: Sequence[Mapping[str, int]], sizes: Sequence[int]) -> Counts:
    """Return the counts of each value with the sizes of the sets."""
    values = dict.fromkeys(value for set_counts in counts for value in set_counts)
    return {
        value: [(set_counts.get(value, 0), size) for set_counts, size in zip(counts, sizes, strict=True)]
        for value in values
    }


def _percents(prefix: str, counts: Counts) -> list[Row]:
    return [(prefix + value, [_percent(*pair) for pair in pairs]) for value, pairs in counts.items()]


def _percent(count: int, total: int) -> str:
    return f"{100 * count / total:.3g} %" if total else MISSING


def _count_text(inspection: Inspection) -> str:
    count, total = len(inspection), len(inspection.scenarios)
    return f"{count:,}" if count == total else f"{count:,} of {total:,}"


def _hours_text(inspection: Inspection) -> str:
    hours = inspection.hours
    return f"{format_short(hours)} h" if hours >= 1 else f"{format_short(60 * hours)} min"


def _rate_text(inspection: Inspection) -> str:
    low, high = inspection.rate_hz()
    return f"{low:.3g} Hz" if high - low < 0.05 else f"{low:.3g} to {high:.3g} Hz"


def _places_text(inspection: Inspection) -> str:
    places = inspection.value_counts(
        lambda entry: [entry["tags"]["place"]] if "place" in entry["tags"] else []
    )
    suffix = f" and {len(places) - _MAX_PLACES} more" if len(places) > _MAX_PLACES else ""
    return ", ".join(list(places)[:_MAX_PLACES]) + suffix if places else MISSING


def _counts_text(counts: Mapping[str, int], total: int) -> str:
    first = list(counts.items())[:_MAX_VALUES]
    texts = [name if count == total else f"{name} ({count:,} of {total:,})" for name, count in first]
    hidden = len(counts) - len(texts)
    return ", ".join(texts) + (f" and {hidden:,} more" if hidden else "") or "none"


def _totals_text(totals: Mapping[str, tuple[int, int]]) -> str:
    texts = [f"{name} {count:,} (in {scenarios:,})" for name, (count, scenarios) in totals.items()]
    return ", ".join(texts) or "nothing"


def observation_overview(statistics: ObservationStatistics) -> str:
    """Summarise the statistics in one line, with the number of NaN or infinite entries."""
    broken = f"{statistics.broken:,} entries are NaN or infinite"
    return (
        f"{statistics.states:,} states of {statistics.episodes:,} episodes of {statistics.planner}, "
        f"{statistics.collisions:,} with a collision; {broken if statistics.broken else 'every number is finite'}"
    )


def observation_table(statistics: ObservationStatistics) -> Table:
    """Return a table with a row per feature, grouped under a row per observation group."""
    names = ["n", "mean", "std", "min", "max", "NaN, Inf", "r collision"]
    names += ["importance"] if statistics.permuted else []
    rows = []
    for group, features in groupby(statistics.features, lambda feature: feature.group):
        empty = (Cell(""),) * (len(names) - 1)
        importance = statistics.groups[group] if statistics.permuted else math.nan
        rows.append((Cell(group, style="group"), *empty, Cell(_decimal(importance))))
        for feature in features:
            texts = _feature_texts(feature)[: len(names)]
            rows.append((Cell(f"  {feature.name}"), *map(Cell, texts)))
    columns = (Column("feature", label=True), *map(Column, names))
    return Table("observations", columns, tuple(rows))


def _feature_texts(feature: FeatureStatistics) -> list[str]:
    numbers = map(_decimal, (feature.mean, feature.std, feature.low, feature.high))
    broken = f"{feature.broken:,}" if feature.broken else ""
    return [f"{feature.count:,}", *numbers, broken, *map(_decimal, (feature.collision, feature.importance))]


def _decimal(value: float) -> str:
    """Return a number with two decimals; empty for NaN."""
    return "" if math.isnan(value) else f"{value:.2f}".replace("-0.00", "0.00")
