"""Tables of ``drivax inspect`` for a terminal: one set in full, or several side by side."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.table import Table

from drivax.report.inspection import QUANTITIES, Entry, Inspection

#: Scenarios that are listed, values of a tag that are named, and sets that stand side by side.
LISTED, NAMED, ABREAST = 30, 6, 4
#: Records that could not be read, of which the cause is told.
_CAUSES = 3


def overview(inspection: Inspection) -> Table:
    """What a set is: counts, size, tags, flags, what did not fit."""
    scenarios, count = inspection.scenarios, len(inspection)
    manifest, capacity = scenarios.manifest, scenarios.capacity
    table = _facts()
    table.add_row("set", str(scenarios.path))
    table.add_row("scenarios", f"{_selected(inspection)} ({_recorded(inspection)}{_shards(inspection)})")
    for name, lacking in inspection.unknown.items():
        table.add_row("", f"{lacking:,} do not know what {name!r} asks for and are left out")
    datasets = inspection.words(lambda entry: [entry["dataset"]])
    table.add_row("data sets", _counted(datasets, count))
    table.add_row("duration", f"{_hours(inspection)} at {_rate(inspection)}")
    size = f"{inspection.megabytes:,.1f} MB, {manifest['record_bytes'] / 1e3:,.0f} kB per scenario"
    table.add_row("size", size)
    table.add_row(
        "capacity",
        f"{capacity.name}: {capacity.agents} moving and {capacity.parked} parked agents, "
        f"{capacity.segments:,} map segments, {capacity.lanes} lanes, {capacity.lights} lights",
    )
    table.add_row("written by", f"drivax {manifest['drivax_version']}, schema {manifest['schema_version']}")
    for label, cell in _not_in_it(inspection.source):
        table.add_row(label, cell)
    for name, values in inspection.tags().items():
        table.add_row(name, _counted(values, count))
    table.add_row("flags", _counted(inspection.words(lambda entry: entry["flags"]), count))
    table.add_row("did not fit", _totals(inspection.totals(lambda entry: entry["overflow"])))
    table.add_row("left out", _totals(inspection.totals(lambda entry: entry["source"].get("lost", {}))))
    table.add_row("integrity", "every checksum is right" if inspection.checked else "not tested (--no-check)")
    return table


def _not_in_it(source: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What a conversion read and did not store: counts, and the first causes."""
    bad, filtered = source.get("skipped_records", []), source.get("filtered", 0)
    if bad:
        yield "skipped", f"{len(bad):,} record{'s' if len(bad) > 1 else ''} that could not be converted"
    for row in bad[:_CAUSES]:
        record = "" if row["record"] is None else f"record {row['record']}: "
        yield "", f"{row['file']}: {record}{row['problem']}"
    if len(bad) > _CAUSES:
        yield "", f"{len(bad) - _CAUSES:,} more in manifest.json"
    if filtered:
        yield (
            "filtered",
            f"{filtered:,} scenario{'s' if filtered > 1 else ''} left out by {' and '.join(source['filters'])}",
        )


def audit_table(inspection: Inspection) -> Table | None:
    """What the replay of the logs found; None where no scenario was audited."""
    names = inspection.findings()
    if not names:
        return None
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("audit", no_wrap=True)
    table.add_column("found")
    table.add_column("n", justify="right")
    for name in names:
        found = inspection.finding(name)
        table.add_row(name, finding_text(found), f"{len(found):,}")
    return table


def finding_text(found: Sequence[Any]) -> str:
    """Truths as a count, numbers as mean, median and largest, words as counts."""
    if all(isinstance(value, bool) for value in found):
        return f"{share(sum(found), len(found))}"
    if all(isinstance(value, str) for value in found):
        words = {word: found.count(word) for word in sorted(set(found))}
        return _counted(words, len(found))
    return spread(np.array(found, np.float64))


def share(number: int, of: int) -> str:
    """A count and its share."""
    return f"{number:,} of {of:,} ({100 * number / of:.3g} %)" if of else "–"


def spread(values: Float[np.ndarray[Any, Any], " n"]) -> str:
    """Mean, median and largest."""
    if not len(values):
        return "–"
    return f"mean {short(values.mean())}, median {short(np.median(values))}, most {short(values.max())}"


def short(value: Any) -> str:
    """A number with about three figures."""
    number = float(value)
    digits = 0 if abs(number) >= 100 or number == round(number) else 1 if abs(number) >= 10 else 2
    return f"{number:,.{digits}f}"


def listing(inspection: Inspection) -> Table:
    """The first scenarios, with the counts of their source."""
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("scenario", no_wrap=True, max_width=24)
    names = ["steps", "tracks", "now", "lanes", "lines", "edges", "others", "points", "lights", "segments"]
    for name in names:
        table.add_column(name, justify="right")
    for entry in inspection.entries[:LISTED]:
        table.add_row(entry["scenario_id"], *(f"{number:,}" for number in _counts(entry)))
    return table


def _counts(entry: Entry) -> tuple[int, ...]:
    source, kinds = entry["source"], entry["source"]["map_features"]
    shown = [kinds.get(name, 0) for name in ("lane", "road_line", "road_edge")]
    return (
        source["steps"],
        source["tracks"],
        source["tracks_valid_now"],
        *shown,
        sum(kinds.values()) - sum(shown),
        source["map_points"],
        source["lights"],
        entry["segments"],
    )


def comparison(inspections: Sequence[Inspection]) -> list[Table]:
    """Several sets side by side, ``ABREAST`` per table: how many, how long, what a scenario holds, shares of tags."""
    groups = [inspections[first : first + ABREAST] for first in range(0, len(inspections), ABREAST)]
    return [_abreast(group) for group in groups]


def _abreast(inspections: Sequence[Inspection]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    table.add_column("", no_wrap=True, style="bold")
    for inspection in inspections:
        table.add_column(inspection.name, justify="right", max_width=24, overflow="fold")
    for label, cells in [*content_rows(inspections), *share_rows(inspections)]:
        table.add_row(label, *cells)
    return table


Rows = list[tuple[str, list[str]]]


def content_rows(inspections: Sequence[Inspection]) -> Rows:
    """How many scenarios, of what, and what one holds on average: a label and one cell per set."""
    rows = [
        ("scenarios", [_selected(one) for one in inspections]),
        ("recordings", [f"{_segments(one):,}" for one in inspections]),
        ("data sets", [", ".join(one.words(lambda entry: [entry["dataset"]])) for one in inspections]),
        ("places", [_places(one) for one in inspections]),
        ("duration", [_hours(one) for one in inspections]),
        ("rate", [_rate(one) for one in inspections]),
        ("skipped", [f"{one.source.get('skipped', 0):,}" for one in inspections]),
        ("MB", [f"{one.megabytes:,.1f}" for one in inspections]),
    ]
    for quantity in QUANTITIES:
        values = [one.values(quantity.read) for one in inspections]
        label = f"{quantity.label}, {quantity.unit}" if quantity.unit else quantity.label
        rows.append((label, [short(found.mean()) if len(found) else "–" for found in values]))
    return rows


def share_rows(inspections: Sequence[Inspection]) -> Rows:
    """Shares of scenarios of which a finding is true, with each value of a tag, with each flag."""
    rows: Rows = []
    findings = {name: None for one in inspections for name in one.findings()}
    for name in findings:
        found = [one.finding(name) for one in inspections]
        if any(isinstance(value, bool) for values in found for value in values):
            rows.append((name, [_percent(sum(map(bool, values)), len(values)) for values in found]))
    tagged = [one.tags() for one in inspections]
    for name in {name: None for tags in tagged for name in tags}:
        if name != "place":
            rows += _tag_rows(name, [tags.get(name, {}) for tags in tagged], inspections)
    counted = [one.words(lambda entry: entry["flags"]) for one in inspections]
    for flag in {flag: None for counts in counted for flag in counts}:
        cells = zip(counted, inspections, strict=True)
        rows.append((f"flag {flag}", [_percent(counts.get(flag, 0), len(one)) for counts, one in cells]))
    return rows


def _tag_rows(name: str, counts: Sequence[Mapping[str, int]], inspections: Sequence[Inspection]) -> Rows:
    """Shares of the values of one tag; nothing for tags with a value for nearly everyone."""
    values = {value: None for found in counts for value in found}
    if len(values) > 2 * NAMED:
        return [(name, [f"{len(found):,} values" if found else "–" for found in counts])]
    return [
        (
            f"{name} {value}",
            [_percent(found.get(value, 0), len(one)) for found, one in zip(counts, inspections, strict=True)],
        )
        for value in values
    ]


def _percent(number: int, of: int) -> str:
    return f"{100 * number / of:.3g} %" if of else "–"


def _facts() -> Table:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    return table


def _selected(inspection: Inspection) -> str:
    count, whole = len(inspection), len(inspection.scenarios)
    return f"{count:,}" if count == whole else f"{count:,} of {whole:,}"


def _segments(inspection: Inspection) -> int:
    return len({(entry["dataset"], entry["segment"]) for entry in inspection.entries})


def _recorded(inspection: Inspection) -> str:
    return f"recorded segments: {_segments(inspection):,}"


def _shards(inspection: Inspection) -> str:
    return f", shards: {len(inspection.scenarios.manifest['shards']):,}"


def _hours(inspection: Inspection) -> str:
    hours = inspection.hours
    return f"{short(hours)} h" if hours >= 1 else f"{short(60 * hours)} min"


def _rate(inspection: Inspection) -> str:
    low, high = inspection.rate_hz()
    return f"{low:.3g} Hz" if high - low < 0.05 else f"{low:.3g} to {high:.3g} Hz"


def _places(inspection: Inspection) -> str:
    places = inspection.words(lambda entry: [entry["tags"]["place"]] if "place" in entry["tags"] else [])
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return ", ".join(list(places)[:NAMED]) + more if places else "–"


def _counted(counts: Mapping[str, int], of: int) -> str:
    parts = [
        name if number == of else f"{name} ({number:,} of {of:,})"
        for name, number in list(counts.items())[: 2 * NAMED]
    ]
    more = len(counts) - len(parts)
    return ", ".join(parts) + (f" and {more:,} more" if more else "") or "none"


def _totals(totals: Mapping[str, tuple[int, int]]) -> str:
    parts = [f"{name} {number:,} (in {places:,})" for name, (number, places) in totals.items()]
    return ", ".join(parts) or "nothing"
