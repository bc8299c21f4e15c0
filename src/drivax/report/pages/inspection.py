"""One self-contained HTML page about scenario sets: a table that compares them, histograms, tags, flags and audit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.report.charts.curves import compact, series_legend, ticks
from drivax.report.inspection import QUANTITIES, Inspection, speeds
from drivax.report.inspection_tables import content_rows, short
from drivax.report.pages.page import page, publish, refuse_page
from drivax.report.pictures.palette import Stroke, stroke
from drivax.scenario.select.selection import FINDINGS

Values = Float[np.ndarray[Any, Any], "_"]
_WIDTH, _HEIGHT = 380, 210
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 10, 34
BINS = 24
#: Tags with more values than this (ids, dates) are no strata and are left out of the page.
_MOST_VALUES = 16


def write_histograms(inspections: Sequence[Inspection], out: Path, overwrite: bool = False) -> Path:
    """Write the page of one or several sets.

    Args:
        inspections: The opened sets, in the order of the columns.
        out: The HTML file; it appears when it is complete.
        overwrite: Replace an existing file.

    Raises:
        UsageError: ``out`` exists.
    """
    refuse_page(out, overwrite)
    names = ", ".join(one.name for one in inspections)
    sections = [_overview(inspections), _quantities(inspections), _shares(inspections), _meaning(inspections)]
    title = f"Scenario sets: {names}" if len(inspections) > 1 else f"Scenario set: {names}"
    publish(out, page(title, f"<p class=lead>{_lead(inspections)}</p>", sections, _STYLE))
    return out


_STYLE = """
.chart rect { stroke: none; }
.bars { display: grid; gap: 14px 28px; grid-template-columns: repeat(auto-fill, minmax(min(100%, 360px), 1fr)); }
.bars h3 { margin-top: 10px; }
.bars table td, .bars table th { border: 0; padding: 1px 6px; font-size: 13px; font-weight: 400; }
.bars tr > :first-child { background: none; position: static; min-width: 0; width: 40%; max-width: none; }
.bars td:last-child { text-align: right; width: 96px; white-space: nowrap; }
.bars i { display: block; box-sizing: content-box; height: 10px; border: solid transparent; border-width: 4.75px 0;
  background-clip: padding-box; }
table.sets { width: auto; }
table.sets td { min-width: 120px; }
.chart figcaption small { display: block; font-weight: 400; }
"""


def histogram(title: str, series: Mapping[str, Values], unit: str = "per scenario") -> str:
    """One histogram as HTML: the share of the values of each series in common bins.

    Args:
        title: Words above it.
        series: Values by name; the lines are those of ``palette.STROKES``, in order.
        unit: Unit of the values, written below the axis.
    """
    everything = np.concatenate(list(series.values()))
    edges = bins(everything)
    shares = {name: _shares_in(values, edges) for name, values in series.items()}
    top = ticks(0.0, max(float(share.max()) for share in shares.values()), 4)
    axes = _Axes(edges[0], edges[-1], top[-1])
    shapes = [axes.level(value) for value in top]
    whole = bool((everything == np.round(everything)).all())
    shapes += [axes.mark(value) for value in _marks(edges[0], edges[-1], whole)]
    for place, share in enumerate(shares.values()):
        shapes.append(axes.steps(edges, share, stroke(place), filled=len(shares) == 1))
    shapes.append(f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 4}" '
                  f'text-anchor="middle">{escape(unit)}</text>')  # fmt: skip
    facts = "".join(
        f"<small>{escape(f'{name}: ' if len(series) > 1 else '')}{_facts(values)}</small>"
        for name, values in series.items()
    )
    return (
        f"<figure class=chart><figcaption>{escape(title)}{facts}</figcaption>"
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(title)}">'
        f"{''.join(shapes)}</svg></figure>"
    )


def bins(values: Values, most: int = BINS) -> Values:
    """Edges of at most ``most`` equal bins of a round width that hold all values, the largest one included.

    Whole numbers get bins that are centred on them while each number has its own.
    """
    low, high = float(values.min()), float(values.max())
    whole = bool((values == np.round(values)).all())
    if low == high:
        return low + np.array([-1.5, -0.5, 0.5, 1.5])
    if whole and high - low < most:
        return np.arange(low - 0.5, high + 1.0)
    edges = ticks(min(low, 0.0) if low < 0.5 * high else low, high, most - 1)
    width = edges[1] - edges[0]
    if whole and width < 1.0:
        return np.arange(math.floor(low), math.ceil(high) + 1.5)
    return np.append(edges, edges[-1] + width) if edges[-1] <= high else np.array(edges)


def _shares_in(values: Values, edges: Values) -> Values:
    counts, _ = np.histogram(values, edges)
    return counts / max(len(values), 1)


def _facts(values: Values) -> str:
    if not len(values):
        return "n 0"
    return f"median {short(np.median(values))}, most {short(values.max())}, n {len(values):,}"


def _marks(low: float, high: float, whole: bool) -> list[float]:
    """Round numbers along the axis, whole ones where all values are."""
    marks = [value for value in ticks(low, high, 5) if low <= value <= high]
    return [value for value in marks if not whole or value == round(value)]


class _Axes:
    """Maps values and shares to the drawing."""

    def __init__(self, low: float, high: float, top: float) -> None:
        self.low, self.high, self.top = float(low), float(high), top

    def x(self, value: float) -> float:
        return _LEFT + (value - self.low) / (self.high - self.low) * (_WIDTH - _LEFT - _RIGHT)

    def y(self, share: float) -> float:
        return _HEIGHT - _BOTTOM - share / self.top * (_HEIGHT - _BOTTOM - _TOP)

    def level(self, share: float) -> str:
        y = self.y(share)
        return (
            f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{compact(100 * share)} %</text>'
        )

    def mark(self, value: float) -> str:
        return (
            f'<text x="{self.x(value):.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">'
            f"{compact(value)}</text>"
        )

    def steps(self, edges: Values, shares: Values, look: Stroke, filled: bool) -> str:
        """Bars of one series, or its outline where several share the drawing."""
        if filled:
            return "".join(
                f'<rect x="{self.x(a) + 0.5:.1f}" y="{self.y(share):.1f}" width="{self.x(b) - self.x(a) - 1:.1f}" '
                f'height="{self.y(0) - self.y(share):.1f}" fill="{look.colour}">'
                f"<title>{compact(a)} to {compact(b)}: {100 * share:.3g} %</title></rect>"
                for a, b, share in zip(edges[:-1], edges[1:], shares, strict=True)
                if share > 0
            )
        corners = [(edges[0], 0.0)]
        for a, b, share in zip(edges[:-1], edges[1:], shares, strict=True):
            corners += [(a, share), (b, share)]
        corners.append((edges[-1], 0.0))
        points = " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in corners)
        return f'<polyline {look.svg} points="{points}"/>'


def _lead(inspections: Sequence[Inspection]) -> str:
    count, recordings = sum(map(len, inspections)), 0
    recordings = len({(e["dataset"], e["segment"]) for one in inspections for e in one.entries})
    hours = sum(one.hours for one in inspections)
    length = f"{short(hours)} hours" if hours >= 1 else f"{short(60 * hours)} minutes"
    return f"<b>{count:,}</b> scenarios of {recordings:,} recordings, {length} of driving."


def _overview(inspections: Sequence[Inspection]) -> str:
    head = "".join(f"<th scope=col>{escape(one.name)}</th>" for one in inspections)
    rows = "".join(
        f"<tr><th scope=row>{escape(label)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for label, cells in content_rows(inspections)
    )
    return (
        "<section><h2>In numbers</h2><div class=scroll tabindex=0 role=region aria-label=sets><table class=sets>"
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{rows}</tbody></table></div><p><small>Numbers of a scenario "
        "are means over the scenarios that know them, counted in the source before cropping and capping. Windows of "
        "one recording may overlap; the duration counts each in full.</small></p></section>"
    )


def _quantities(inspections: Sequence[Inspection]) -> str:
    charts = []
    for quantity in QUANTITIES:
        series = {one.name: one.values(quantity.read) for one in inspections}
        if any(len(values) for values in series.values()):
            charts.append(histogram(quantity.label, series, quantity.unit or "per scenario"))
    found = [speeds(one) for one in inspections]
    names = [one.name for one in inspections]
    for title, kind in (("speed of ego", "ego"), ("speed of other vehicles now", "vehicles")):
        series = {name: getattr(one, kind) for name, one in zip(names, found, strict=True)}
        if any(len(values) for values in series.values()):
            charts.append(histogram(title, series, "m/s"))
    sampled = [
        f"{one.scenarios:,} of {len(inspection):,} scenarios of {inspection.name}"
        for one, inspection in zip(found, inspections, strict=True)
        if one.scenarios < len(inspection)
    ]
    note = f"<p><small>Speeds: {escape('; '.join(sampled))}, evenly spread.</small></p>" if sampled else ""
    drawn = f"<div class=charts>{''.join(charts)}</div>"
    return f"<section><h2>Histograms</h2>{_legend(inspections)}{drawn}{note}</section>"


def _legend(inspections: Sequence[Inspection]) -> str:
    return series_legend([one.name for one in inspections]) if len(inspections) > 1 else ""


def _shares(inspections: Sequence[Inspection]) -> str:
    """Shares of scenarios by tag, flag and what the audit found."""
    tagged = [one.tags() for one in inspections]
    parts = []
    sizes = [len(one) for one in inspections]
    for name in dict.fromkeys(name for tags in tagged for name in tags):
        counts = [tags.get(name, {}) for tags in tagged]
        if len({value for found in counts for value in found}) <= _MOST_VALUES:
            parts.append(_bars(name, _of_all(counts, sizes)))
    flags = [one.words(lambda entry: entry["flags"]) for one in inspections]
    parts.append(_bars("flags", _of_all(flags, sizes)))
    truths = {}
    for name in dict.fromkeys(name for one in inspections for name in one.findings()):
        found = [one.finding(name) for one in inspections]
        if any(isinstance(value, bool) for values in found for value in values):
            truths[name] = [(sum(values), len(values)) for values in found]
    parts.append(_bars("audit", truths))
    legend = _legend(inspections)
    return f"<section><h2>Tags, flags, audit</h2>{legend}<div class=bars>{''.join(parts)}</div></section>"


Counts = dict[str, list[tuple[int, int]]]


def _of_all(counts: Sequence[Mapping[str, int]], sizes: Sequence[int]) -> Counts:
    """Per value and set, how many scenarios of how many."""
    values = dict.fromkeys(value for found in counts for value in found)
    return {
        value: [(found.get(value, 0), size) for found, size in zip(counts, sizes, strict=True)]
        for value in values
    }


def _bars(title: str, counts: Counts) -> str:
    """Horizontal bars: one row per value, one bar per set."""
    rows = []
    for value, found in counts.items():
        bars = "".join(
            f'<i style="width:{100 * number / max(of, 1):.2f}%;background:{stroke(place).key}"></i>'
            for place, (number, of) in enumerate(found)
        )
        words = "<br>".join(f"{number:,} ({100 * number / of:.3g} %)" if of else "–" for number, of in found)
        rows.append(f"<tr><th scope=row>{escape(value)}</th><td>{bars}</td><td>{words}</td></tr>")
    return f"<div><h3>{escape(title)}</h3><table>{''.join(rows)}</table></div>" if rows else ""


def _meaning(inspections: Sequence[Inspection]) -> str:
    names = dict.fromkeys(name for one in inspections for name in one.findings())
    items = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(FINDINGS[name].meaning)}</dd></div>"
        for name in names
        if name in FINDINGS
    )
    return (
        f"<section><h2>What the audit looks at</h2><dl class=metrics>{items}</dl></section>" if items else ""
    )
