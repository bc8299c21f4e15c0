"""One self-contained HTML page about scenario sets: a table of sizes, histograms, tags, flags and audit."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from drivax.files import check_output, write_text
from drivax.report.charts import format_short, histogram, series_legend
from drivax.report.inspection import (
    QUANTITIES,
    Counts,
    Inspection,
    content_table,
    read_speeds,
    true_findings,
    with_distinct_names,
    with_sizes,
)
from drivax.report.pages.page import asset, definitions, page, section
from drivax.report.pictures.palette import stroke
from drivax.scenario.select.selection import FINDINGS
from drivax.stats.clusters import recordings_of

#: Tags with more values, such as ids and dates, are not shown.
_MAX_TAG_VALUES = 16


def write_histograms(inspections: Sequence[Inspection], out: Path, overwrite: bool = False) -> Path:
    """Write a page about scenario sets to the HTML file ``out``.

    Raises:
        UsageError: ``out`` exists without ``overwrite``, or is a folder.
    """
    check_output(out, overwrite)
    inspections = with_distinct_names(inspections)
    sections = [_overview(inspections), _quantities(inspections), _shares(inspections), _meaning(inspections)]
    names = ", ".join(inspection.name for inspection in inspections)
    title = f"Scenario set{'s' if len(inspections) > 1 else ''}: {names}"
    write_text(out, page(title, f"<p class=lead>{_lead(inspections)}</p>", sections, asset("inspection.css")))
    return out


def _lead(inspections: Sequence[Inspection]) -> str:
    count = sum(map(len, inspections))
    recordings = len(
        set(recordings_of([entry for inspection in inspections for entry in inspection.entries]))
    )
    hours = sum(inspection.hours for inspection in inspections)
    length = f"{format_short(hours)} hours" if hours >= 1 else f"{format_short(60 * hours)} minutes"
    return f"<b>{count:,}</b> scenarios of {recordings:,} recordings, {length} of driving."


def _overview(inspections: Sequence[Inspection]) -> str:
    note = (
        "Means over the scenarios that define a number. Agents, tracks, steps, map features, map points and lights are "
        "counted in the source, before cropping and capping. Windows of one recording may overlap; the duration counts "
        "each in full."
    )
    return section("In numbers", content_table(inspections).html(), note=note)


def _quantities(inspections: Sequence[Inspection]) -> str:
    names = [inspection.name for inspection in inspections]
    series = []
    for quantity in QUANTITIES:
        values = [inspection.values(quantity.read) for inspection in inspections]
        series.append((quantity.label, quantity.unit or "per scenario", values))
    samples = [read_speeds(inspection) for inspection in inspections]
    series.append(("speed of ego", "m/s", [sample.ego for sample in samples]))
    series.append(("speed of other vehicles now", "m/s", [sample.vehicles for sample in samples]))
    charts = "".join(
        histogram(title, dict(zip(names, values, strict=True)), unit)
        for title, unit, values in series
        if any(map(len, values))
    )
    counts = [
        f"{sample.scenarios:,} of {len(inspection):,} scenarios of {inspection.name}"
        for sample, inspection in zip(samples, inspections, strict=True)
        if sample.scenarios < len(inspection)
    ]
    note = f"Speeds: {escape('; '.join(counts))}, evenly spread." if counts else ""
    return section("Histograms", _legend(inspections), f"<div class=charts>{charts}</div>", note=note)


def _legend(inspections: Sequence[Inspection]) -> str:
    return series_legend([inspection.name for inspection in inspections]) if len(inspections) > 1 else ""


def _shares(inspections: Sequence[Inspection]) -> str:
    """Return the shares of scenarios by tag, flag and audit finding."""
    tags_by_set = [inspection.tags() for inspection in inspections]
    sizes = [len(inspection) for inspection in inspections]
    groups = {
        name: with_sizes([tags.get(name, {}) for tags in tags_by_set], sizes)
        for name in dict.fromkeys(name for tags in tags_by_set for name in tags)
    }
    flags = [inspection.value_counts(lambda entry: entry["flags"]) for inspection in inspections]
    bars = [_bars(name, counts) for name, counts in groups.items() if len(counts) <= _MAX_TAG_VALUES]
    bars += [_bars("flags", with_sizes(flags, sizes)), _bars("audit", true_findings(inspections))]
    return section("Tags, flags, audit", _legend(inspections), f"<div class=bars>{''.join(bars)}</div>")


def _bars(title: str, counts: Counts) -> str:
    """Return horizontal bars: one row per value, one bar per set."""
    rows = []
    for value, pairs in counts.items():
        bars = "".join(
            f'<i style="width:{100 * count / max(total, 1):.2f}%;background:{stroke(index).key}"></i>'
            for index, (count, total) in enumerate(pairs)
        )
        texts = "<br>".join(f"{n:,} ({100 * n / total:.3g} %)" if total else "–" for n, total in pairs)
        rows.append(f"<tr><th scope=row>{escape(value)}</th><td>{bars}</td><td>{texts}</td></tr>")
    return f"<div><h3>{escape(title)}</h3><table>{''.join(rows)}</table></div>" if rows else ""


def _meaning(inspections: Sequence[Inspection]) -> str:
    names = dict.fromkeys(name for inspection in inspections for name in inspection.findings())
    items = [(name, FINDINGS[name].meaning) for name in names if name in FINDINGS]
    return section("What the audit checks", definitions(items)) if items else ""
