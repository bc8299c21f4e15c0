"""Tables of ``drivax inspect``: one set in full, several side by side, and what a policy observes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.evaluation.observation_statistics import FeatureStatistics, ObservationStatistics
from drivax.report.charts.distributions import short
from drivax.report.inspection import QUANTITIES, Entry, Inspection
from drivax.table import MISSING, Cell, Column, Table

#: Listed scenarios, named values of a tag, sets next to each other, and printed causes of unreadable records, at most.
LISTED, NAMED, ACROSS, _CAUSES = 30, 6, 4, 3
#: A label and one text per set.
Row = tuple[str, list[str]]


def overview(inspection: Inspection) -> Table:
    """Return the facts of a set: counts, size, tags, flags, overflow."""
    scenarios, count = inspection.scenarios, len(inspection)
    manifest, capacity = scenarios.manifest, scenarios.capacity
    segments = f"recorded segments: {inspection.recordings:,}, shards: {len(manifest['shards']):,}"
    rows = [("set", str(scenarios.path)), ("scenarios", f"{_selected(inspection)} ({segments})")]
    rows += [
        ("", f"{lacking:,} lack what {name!r} asks for and are left out")
        for name, lacking in inspection.unknown.items()
    ]
    size = f"{inspection.megabytes:,.1f} MB, {manifest['record_bytes'] / 1e3:,.0f} kB per scenario"
    rows += [
        ("data sets", _counted(inspection.words(lambda entry: [entry["dataset"]]), count)),
        ("duration", f"{_hours(inspection)} at {_rate(inspection)}"),
        ("size", size),
        (
            "capacity",
            f"{capacity.name}: {capacity.agents} moving and {capacity.parked} parked agents, "
            f"{capacity.segments:,} map segments, {capacity.lanes} lanes, {capacity.lights} lights",
        ),
        ("written by", f"drivax {manifest['drivax_version']}, schema {manifest['schema_version']}"),
        *_left_out(inspection.source),
        *((name, _counted(values, count)) for name, values in inspection.tags().items()),
        ("flags", _counted(inspection.words(lambda entry: entry["flags"]), count)),
        ("did not fit", _totals(inspection.totals(lambda entry: entry["overflow"]))),
        ("left out", _totals(inspection.totals(lambda entry: entry["source"].get("lost", {})))),
        ("integrity", "every checksum is right" if inspection.checked else "not tested (--no-check)"),
    ]
    return _table("overview", ["", ""], [(label, [text]) for label, text in rows], left=True)


def _left_out(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what a conversion read and did not store: counts, and the first causes."""
    bad, filtered = source.get("skipped_records", []), source.get("filtered", 0)
    if bad:
        yield "skipped", f"{len(bad):,} record{'s' if len(bad) > 1 else ''} that could not be converted"
    for row in bad[:_CAUSES]:
        record = "" if row["record"] is None else f"record {row['record']}: "
        yield "", f"{row['file']}: {record}{row['problem']}"
    if len(bad) > _CAUSES:
        yield "", f"{len(bad) - _CAUSES:,} more in manifest.json"
    if filtered:
        filters = " and ".join(source["filters"])
        yield "filtered", f"{filtered:,} scenario{'s' if filtered > 1 else ''} left out by {filters}"


def audit_table(inspection: Inspection) -> Table | None:
    """Return the findings of the log replay; None where no scenario was audited."""
    names = inspection.findings()
    if not names:
        return None
    columns = (Column("audit", label=True), Column("found", left=True), Column("n"))
    values = {name: inspection.finding(name) for name in names}
    rows = tuple(
        (Cell(name), Cell(finding_text(known)), Cell(f"{len(known):,}")) for name, known in values.items()
    )
    return Table("audit", columns, rows)


def finding_text(values: Sequence[Any]) -> str:
    """Return booleans as a count, numbers as mean, median and largest, words as counts."""
    if all(isinstance(value, bool) for value in values):
        return _share(sum(values), len(values))
    if all(isinstance(value, str) for value in values):
        return _counted({word: values.count(word) for word in sorted(set(values))}, len(values))
    return _spread(np.array(values, np.float64))


def _share(count: int, of: int) -> str:
    """Return a count with its share."""
    return f"{count:,} of {of:,} ({100 * count / of:.3g} %)" if of else MISSING


def _spread(values: Float[np.ndarray[Any, Any], " n"]) -> str:
    """Return mean, median and largest value."""
    if not len(values):
        return MISSING
    return f"mean {short(values.mean())}, median {short(np.median(values))}, most {short(values.max())}"


def listing(inspection: Inspection) -> Table:
    """Return the first scenarios with the counts of their source."""
    names = ("steps", "tracks", "now", "lanes", "lines", "edges", "others", "points", "lights", "segments")
    columns = (Column("scenario", label=True, most=24), *map(Column, names))
    rows = tuple(
        (Cell(entry["scenario_id"]), *(Cell(f"{count:,}") for count in _counts(entry)))
        for entry in inspection.entries[:LISTED]
    )
    return Table("scenarios", columns, rows)


def _counts(entry: Entry) -> tuple[int, ...]:
    source, kinds = entry["source"], entry["source"]["map_features"]
    shown = [kinds.get(name, 0) for name in ("lane", "road_line", "road_edge")]
    first = [source[name] for name in ("steps", "tracks", "tracks_valid_now")]
    others = sum(kinds.values()) - sum(shown)
    return (*first, *shown, others, source["map_points"], source["lights"], entry["segments"])


def comparison(inspections: Sequence[Inspection]) -> list[Table]:
    """Return several sets side by side, ``ACROSS`` per table: sizes, averages per scenario, shares of tags."""
    groups = [inspections[first : first + ACROSS] for first in range(0, len(inspections), ACROSS)]
    return [content_table(group, _share_rows(group), most=24) for group in groups]


def content_table(inspections: Sequence[Inspection], more: Sequence[Row] = (), **columns: Any) -> Table:
    """Return sizes of sets and averages of their scenarios, one column per set."""
    rows: list[Row] = [
        ("scenarios", [_selected(inspection) for inspection in inspections]),
        ("recordings", [f"{inspection.recordings:,}" for inspection in inspections]),
        (
            "data sets",
            [", ".join(inspection.words(lambda entry: [entry["dataset"]])) for inspection in inspections],
        ),
        ("places", [_places(inspection) for inspection in inspections]),
        ("duration", [_hours(inspection) for inspection in inspections]),
        ("rate", [_rate(inspection) for inspection in inspections]),
        ("skipped", [f"{inspection.source.get('skipped', 0):,}" for inspection in inspections]),
        ("MB", [f"{inspection.megabytes:,.1f}" for inspection in inspections]),
    ]
    for quantity in QUANTITIES:
        known = [inspection.values(quantity.read) for inspection in inspections]
        label = f"{quantity.label}, {quantity.unit}" if quantity.unit else quantity.label
        rows.append((label, [short(values.mean()) if len(values) else MISSING for values in known]))
    names = ["", *(inspection.name for inspection in inspections)]
    return _table("sets", names, [*rows, *more], **columns)


def _table(name: str, headings: Sequence[str], rows: Sequence[Row], **columns: Any) -> Table:
    """Return a table of texts under one label column."""
    heads = (Column(headings[0], label=True), *(Column(heading, **columns) for heading in headings[1:]))
    return Table(name, heads, tuple((Cell(label), *map(Cell, texts)) for label, texts in rows))


def _share_rows(inspections: Sequence[Inspection]) -> list[Row]:
    """Return shares of scenarios with a finding, a value of a tag, a flag."""
    sizes = [len(inspection) for inspection in inspections]
    rows = [
        (name, [_percent(*count) for count in counts]) for name, counts in true_findings(inspections).items()
    ]
    tagged = [inspection.tags() for inspection in inspections]
    for name in {name: None for tags in tagged for name in tags}:
        counts = [tags.get(name, {}) for tags in tagged]
        values = {value: None for of_set in counts for value in of_set}
        if name != "place" and len(values) > 2 * NAMED:
            rows.append((name, [f"{len(of_set):,} values" if of_set else MISSING for of_set in counts]))
        elif name != "place":
            rows += _percents(f"{name} ", of_all(counts, sizes))
    flags = [inspection.words(lambda entry: entry["flags"]) for inspection in inspections]
    return rows + _percents("flag ", of_all(flags, sizes))


#: Per value, ``(count, of)`` for each set.
Counts = dict[str, list[tuple[int, int]]]


def true_findings(inspections: Sequence[Inspection]) -> Counts:
    """Return for each yes-or-no finding of the audit in how many of how many scenarios it is true."""
    findings = {}
    for name in dict.fromkeys(name for inspection in inspections for name in inspection.findings()):
        known = [inspection.finding(name) for inspection in inspections]
        if any(isinstance(value, bool) for values in known for value in values):
            findings[name] = [(sum(map(bool, values)), len(values)) for values in known]
    return findings


def of_all(counts: Sequence[Mapping[str, int]], sizes: Sequence[int]) -> Counts:
    """Return the counts of each value with the sizes of the sets."""
    values = dict.fromkeys(value for of_set in counts for value in of_set)
    return {
        value: [(of_set.get(value, 0), size) for of_set, size in zip(counts, sizes, strict=True)]
        for value in values
    }


def _percents(prefix: str, counts: Counts) -> list[Row]:
    return [(prefix + value, [_percent(*count) for count in sets]) for value, sets in counts.items()]


def _percent(count: int, of: int) -> str:
    return f"{100 * count / of:.3g} %" if of else MISSING


def _selected(inspection: Inspection) -> str:
    count, whole = len(inspection), len(inspection.scenarios)
    return f"{count:,}" if count == whole else f"{count:,} of {whole:,}"


def _hours(inspection: Inspection) -> str:
    hours = inspection.hours
    return f"{short(hours)} h" if hours >= 1 else f"{short(60 * hours)} min"


def _rate(inspection: Inspection) -> str:
    low, high = inspection.rate_hz()
    return f"{low:.3g} Hz" if high - low < 0.05 else f"{low:.3g} to {high:.3g} Hz"


def _places(inspection: Inspection) -> str:
    places = inspection.words(lambda entry: [entry["tags"]["place"]] if "place" in entry["tags"] else [])
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return ", ".join(list(places)[:NAMED]) + more if places else MISSING


def _counted(counts: Mapping[str, int], of: int) -> str:
    texts = [
        name if count == of else f"{name} ({count:,} of {of:,})"
        for name, count in list(counts.items())[: 2 * NAMED]
    ]
    more = len(counts) - len(texts)
    return ", ".join(texts) + (f" and {more:,} more" if more else "") or "none"


def _totals(totals: Mapping[str, tuple[int, int]]) -> str:
    texts = [f"{name} {count:,} (in {scenarios:,})" for name, (count, scenarios) in totals.items()]
    return ", ".join(texts) or "nothing"


def observation_overview(statistics: ObservationStatistics) -> str:
    """Return the size of the statistics in one line, with the number of NaN or infinite entries."""
    states = f"{statistics.states:,} states of {statistics.episodes:,} episodes of {statistics.planner}"
    finite = (
        f"{statistics.broken:,} entries are NaN or infinite"
        if statistics.broken
        else "every number is finite"
    )
    return f"{states}, {statistics.collisions:,} with a collision; {finite}"


def observation_table(statistics: ObservationStatistics) -> Table:
    """Return a row per column of each group, under a row for the group."""
    names = ["n", "mean", "std", "min", "max", "NaN, Inf", "r collision"]
    names += ["importance"] if statistics.permuted else []
    rows, group = [], None
    for feature in statistics.features:
        if feature.group != group:
            group = feature.group
            empty = (Cell(""),) * (len(names) - 1)
            last = statistics.groups[group] if statistics.permuted else math.nan
            rows.append((Cell(group, style="group"), *empty, Cell(_decimal(last))))
        rows.append(
            (Cell(f"  {feature.name}"), *map(Cell, _feature_texts(feature, bool(statistics.permuted))))
        )
    columns = (Column("feature", label=True), *map(Column, names))
    return Table("observations", columns, tuple(rows))


def _feature_texts(feature: FeatureStatistics, permuted: bool) -> list[str]:
    numbers = [_decimal(value) for value in (feature.mean, feature.std, feature.low, feature.high)]
    broken = f"{feature.broken:,}" if feature.broken else ""
    importance = [_decimal(feature.importance)] if permuted else []
    return [f"{feature.count:,}", *numbers, broken, _decimal(feature.collision), *importance]


def _decimal(value: float) -> str:
    """Return a number with two decimals; empty for NaN."""
    return "" if math.isnan(value) else f"{value:.2f}".replace("-0.00", "0.00")
