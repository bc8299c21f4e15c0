"""A comparison of two planners as one self-contained HTML page."""

from __future__ import annotations

import json
from html import escape
from importlib import metadata
from pathlib import Path

from drivax import settings
from drivax.evaluation.comparison import Comparison
from drivax.files import check_output, write_text
from drivax.report.comparison import comparison_tables, conditions, effect_name, notes, reasons, title
from drivax.report.pages.page import facts_html, page

_STYLE = """
td svg { display: block; width: 180px; height: 34px; margin-left: auto; }
td svg line { stroke: var(--soft); stroke-width: 1; }
td svg .span { stroke: var(--ink); stroke-width: 2; }
td svg circle { fill: var(--ink); }
td svg text { font-size: 10px; fill: var(--soft); }
"""


def write_comparison(comparison: Comparison, out: Path, overwrite: bool = False) -> Path:
    """Write the page of a comparison to the HTML file ``out``.

    Raises:
        UsageError: ``out`` exists.
    """
    check_output(out, overwrite)
    names = f"{comparison.names[0]} against {comparison.names[1]}"
    label = f"{comparison.plan.name}: " if comparison.plan.name else ""
    sections = [_metrics(comparison), _plan(comparison), _origin(comparison)]
    write_text(out, page(f"{label}{names}", _lead(comparison), sections, _STYLE))
    return out


def _lead(comparison: Comparison) -> str:
    items = "".join(f"<li>{escape(reason)}</li>" for reason in reasons(comparison))
    a, b = map(escape, comparison.names)
    return (
        f"<p class=lead>Recommendation: <b>{escape(title(comparison))}</b></p><ul>{items}</ul>"
        f"<p><small>A is {a}, B is {b}; {escape(conditions(comparison))}.</small></p>"
    )


def _metrics(comparison: Comparison) -> str:
    items = "".join(f"<li>{escape(note)}</li>" for note in notes(comparison))
    a, b = comparison.names
    tables = "".join(f"{table.html()}<br>" for table in comparison_tables(comparison, (f"A: {a}", f"B: {b}")))
    share = f"{100 * comparison.plan.confidence:.0f} %"
    kind = "d_z, the mean of the differences over their standard deviation"
    kind = kind if effect_name(comparison) == "d_z" else "d, with the pooled standard deviation"
    level = f"{1 - comparison.plan.confidence:.2g}"
    return (
        f"<section><h2>Metrics</h2>{tables}{f'<ul>{items}</ul>' if items else ''}<p><small>Mean and {share} "
        "interval; whole recordings are resampled. n: scenarios where the metric is defined. Effect size: Cohen's "
        f"{kind}. A planner is called better where the two-sided p-value is below {level}; p-values of secondary "
        "metrics are adjusted for their number by Holm's method.</small></p></section>"
    )


def _plan(comparison: Comparison) -> str:
    plan = comparison.plan
    return (
        "<section><h2>The rule</h2><p>Nothing is decided with fewer than "
        f"{plan.minimum_scenarios:,} scenarios. A p-value below {1 - plan.confidence:.2g} gives the better planner. "
        "Otherwise there is no difference if the smallest difference that matters would have been detected with a "
        f"power of {100 * plan.power:.0f} %, and if not, there are not enough scenarios.</p>"
        f"<details><summary>the plan</summary><pre>{escape(settings.dump(plan))}</pre></details></section>"
    )


def _origin(comparison: Comparison) -> str:
    rows = [
        (f"{arm}: {name}", [str(folder)])
        for arm, name, folder in zip("AB", comparison.names, comparison.folders, strict=True)
    ]
    numbers = escape(json.dumps(comparison.as_dict(), indent=1, ensure_ascii=False))
    return (
        f"<section><h2>How this was made</h2>{facts_html(['', ''], rows)}"
        f"<details><summary>all numbers</summary><pre>{numbers}</pre></details>"
        f"<p><small>drivax {escape(metadata.version('drivax'))}. Every number comes from the episodes.csv of both runs."
        "</small></p></section>"
    )
