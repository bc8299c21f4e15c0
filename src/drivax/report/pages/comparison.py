"""A comparison of two planners as one self-contained HTML page."""

from __future__ import annotations

import json
from html import escape
from importlib import metadata
from pathlib import Path

from drivax import settings
from drivax.evaluation.comparison import Comparison
from drivax.evaluation.decision import MetricComparison
from drivax.report.comparison_text import (
    conditions,
    effect,
    effect_name,
    heading,
    how_tested,
    metric_note,
    notes,
    p_value,
    reasons,
    title,
)
from drivax.report.glossary import Note
from drivax.report.html_tables import bounds, number, percent
from drivax.report.pages.page import page, publish, refuse_page
from drivax.stats.intervals import Interval

_WIDTH, _HEIGHT = 180, 34
_STYLE = """
td svg { display: block; width: 180px; height: 34px; margin-left: auto; }
td svg line { stroke: var(--soft); stroke-width: 1; }
td svg .span { stroke: var(--ink); stroke-width: 2; }
td svg circle { fill: var(--ink); }
td svg text { font-size: 10px; fill: var(--soft); }
.plan td { text-align: left; }
"""


def write_comparison(found: Comparison, out: Path, overwrite: bool = False) -> Path:
    """Write the page of a comparison; it appears when it is complete.

    Args:
        found: The comparison.
        out: HTML file to write.
        overwrite: Replace an existing file.

    Raises:
        UsageError: ``out`` exists.
    """
    refuse_page(out, overwrite)
    names = f"{found.names[0]} against {found.names[1]}"
    label = f"{found.plan.name}: " if found.plan.name else ""
    sections = [_metrics(found), _plan(found), _made(found)]
    publish(out, page(f"{label}{names}", _lead(found), sections, _STYLE))
    return out


def _lead(found: Comparison) -> str:
    items = "".join(f"<li>{escape(reason)}</li>" for reason in reasons(found))
    return (
        f"<p class=lead>Recommendation: <b>{escape(title(found))}</b></p><ul>{items}</ul>"
        f"<p><small>A is {escape(found.names[0])}, B is {escape(found.names[1])}; "
        f"{escape(conditions(found))}.</small></p>"
    )


def _metrics(found: Comparison) -> str:
    told = "".join(f"<li>{escape(one)}</li>" for one in notes(found))
    parts = [_table(found, "primary metric", "p", [found.primary])]
    if found.secondary:
        parts.append(_table(found, "secondary metrics", "p (Holm)", list(found.secondary)))
    share = f"{100 * found.plan.confidence:.0f} %"
    kind = "d_z, the mean of the differences over their standard deviation"
    kind = kind if effect_name(found) == "d_z" else "d, with the pooled standard deviation"
    level = f"{1 - found.plan.confidence:.2g}"
    return (
        f"<section><h2>Metrics</h2>{''.join(parts)}{f'<ul>{told}</ul>' if told else ''}<p><small>Mean and {share} "
        "interval; recordings are resampled whole. n: scenarios where the metric is defined. Effect size: Cohen's "
        f"{kind}. “Better” is said where the two-sided p-value is below {level}; those of secondary metrics are "
        "adjusted for their number by Holm's method.</small></p></section>"
    )


def _table(found: Comparison, caption: str, p_head: str, rows: list[MetricComparison]) -> str:
    a, b = (escape(name) for name in found.names)
    heads = [f"A: {a}", f"B: {b}", "A − B", "beside zero", effect_name(found), p_head, "n", "better"]
    head = "".join(f"<th scope=col>{cell}</th>" for cell in heads)
    body = "".join(_row(one) for one in rows)
    return (
        f'<div class=scroll tabindex=0 role=region aria-label="{caption}"><table><thead><tr>'
        f"<th scope=col>{caption}</th>{head}</tr></thead><tbody>{body}</tbody></table></div><br>"
    )


def _row(one: MetricComparison) -> str:
    entry = metric_note(one)
    effects = ", ".join(f"{name} {value:.3f}" for name, value in one.effects.items() if value is not None)
    cells = [
        _cell(one.a, entry),
        _cell(one.b, entry),
        _cell(one.difference, entry, signed=True),
        f"<td>{_picture(one, entry)}</td>",
        f'<td title="{escape(effects)}">{effect(one)}</td>',
        f"<td>{escape(p_value(one.p_adjusted))}<small>{escape(how_tested(one))}</small></td>",
        f"<td>{one.difference.n:,}</td>",
        f"<td><b>{one.winner or '–'}</b></td>",
    ]
    tip = escape(entry.explanation or one.metric)
    return f'<tr><th scope=row title="{tip}">{escape(heading(one))}</th>{"".join(cells)}</tr>'


def _cell(interval: Interval, entry: Note, signed: bool = False) -> str:
    points = " points" if entry.unit == "rate" else ""
    sign = points if signed else percent(entry.unit)
    mean = number(interval.mean, entry.unit, signed) + ("" if interval.mean is None else sign)
    return f"<td><b>{mean}</b><small>{bounds(interval, entry.unit, signed)}</small></td>"


def _picture(one: MetricComparison, entry: Note) -> str:
    """The interval of the difference beside zero; left of it B has more, right of it A."""
    mean, low, high = one.difference.mean, one.difference.low, one.difference.high
    if mean is None or low is None or high is None or low == high:
        return ""
    reach = 1.15 * max(abs(low), abs(high))
    at = [_WIDTH / 2 * (1 + value / reach) for value in (low, mean, high)]
    words = (
        f"A − B: {number(mean, entry.unit, signed=True)}, {bounds(one.difference, entry.unit, signed=True)}"
    )
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(words)}">'
        f'<line x1="{_WIDTH / 2}" x2="{_WIDTH / 2}" y1="2" y2="22"/>'
        f'<line class="span" x1="{at[0]:.1f}" x2="{at[2]:.1f}" y1="12" y2="12"/>'
        f'<circle cx="{at[1]:.1f}" cy="12" r="4"/>'
        f'<text x="{_WIDTH / 2}" y="32" text-anchor="middle">0</text></svg>'
    )


def _plan(found: Comparison) -> str:
    plan = found.plan
    return (
        "<section><h2>The rule</h2><p>Nothing is decided with fewer than "
        f"{plan.minimum_scenarios:,} scenarios. A p-value below {1 - plan.confidence:.2g} gives the better planner. "
        "Otherwise there is no difference if the smallest difference that matters would have been found with a power "
        f"of {100 * plan.power:.0f} %, and if not, there are not enough scenarios.</p>"
        f"<details><summary>the plan</summary><pre>{escape(settings.dump(plan))}</pre></details></section>"
    )


def _made(found: Comparison) -> str:
    rows = "".join(
        f"<tr><th scope=row>{arm}: {escape(name)}</th><td>{escape(str(folder))}</td></tr>"
        for arm, name, folder in zip("AB", found.names, found.folders, strict=True)
    )
    whole = escape(json.dumps(found.as_dict(), indent=1, ensure_ascii=False))
    return (
        "<section><h2>How this was made</h2><div class=scroll tabindex=0><table class=facts>"
        f"<tbody>{rows}</tbody></table></div><details><summary>all numbers</summary><pre>{whole}</pre></details>"
        f"<p><small>drivax {escape(metadata.version('drivax'))}. Every number comes from the episodes.csv of both runs."
        "</small></p></section>"
    )
