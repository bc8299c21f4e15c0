"""Tables of a report as HTML. A cell that knows which episodes are behind it says so to the page's programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from drivax.evaluation.pairing import mismatch
from drivax.evaluation.tables import Row, Table, summarise
from drivax.report.comparison import Difference, difference
from drivax.report.glossary import ARROWS, Note, note
from drivax.report.loaded_runs import Evaluation
from drivax.stats.intervals import Interval

#: Sign and words of a verdict; the sign repeats in shape what the colour says.
_VERDICTS = {
    "better": ("▲", "better"),
    "worse": ("▼", "worse"),
    "unclear": ("", "unclear"),
    "same": ("=", "same"),
    "none": ("", ""),
}


def planner_table(runs: Sequence[Evaluation], metrics: Sequence[str]) -> str:
    """Planners in rows, metrics in columns: mean, interval and number of episodes in each cell."""
    cells = {(run.name, metric): summarise(run, metric) for run in runs for metric in metrics}
    notes = {metric: note(metric, runs) for metric in metrics}
    best = {metric: _best([cells[run.name, metric] for run in runs], notes[metric]) for metric in metrics}
    head = "".join(_heading(metric, notes[metric]) for metric in metrics)
    rows = []
    for run in runs:
        row = "".join(
            _cell(cells[run.name, m], notes[m], best[m], {"run": run.name, "metric": m}) for m in metrics
        )
        rows.append(f"<tr>{_planner(run)}{row}</tr>")
    return _scrolling(f"<thead><tr><th scope=col>planner</th>{head}</tr></thead>", "".join(rows), "planners")


def difference_table(policy: Evaluation, others: Sequence[Evaluation], metrics: Sequence[str]) -> str:
    """Metrics in rows, other planners in columns: the policy minus the other, paired by scenario."""
    head = "".join(f"<th scope=col>against {escape(other.name)}</th>" for other in others)
    rows = []
    for metric in metrics:
        cells = "".join(_difference_cell(policy, other, metric) for other in others)
        rows.append(f"<tr>{_heading(metric, note(metric, [policy]), scope='row')}{cells}</tr>")
    return _scrolling(
        f"<thead><tr><th scope=col>metric</th>{head}</tr></thead>", "".join(rows), "differences"
    )


def table_html(
    table: Table, runs: Sequence[Evaluation], behind: Callable[[Row, int], Mapping[str, Any]]
) -> str:
    """A table of ``evaluation.tables``.

    Args:
        table: The table; metrics, where it has any, stand in its columns.
        runs: Evaluations, which say what metrics of the user's own are.
        behind: From a row and the number of a column to what the page's list of episodes is asked for.
    """
    keys = "".join(f"<th scope=col>{escape(key)}</th>" for key in table.keys)
    named = table.across == "metric"
    head = "".join(
        _heading(name, note(name, runs)) if named else f"<th scope=col>{escape(name)}</th>"
        for name in table.columns
    )
    rows = []
    for row in table.rows:
        labels = "".join(f"<th scope=row>{escape(label)}</th>" for label in row.labels)
        cells = "".join(
            "<td class=undefined>–</td>"
            if cell is None
            else _cell(cell.interval, note(cell.metric, runs), None, behind(row, place))
            for place, cell in enumerate(row.cells)
        )
        rows.append(f"<tr>{labels}{cells}</tr>")
    return _scrolling(f"<thead><tr>{keys}{head}</tr></thead>", "".join(rows), table.name)


def explanations(metrics: Sequence[str], runs: Sequence[Evaluation]) -> str:
    """A list that explains each metric in one line; metrics without an explanation are left out."""
    known = [entry for metric in metrics if (entry := note(metric, runs)).explanation]
    items = "".join(
        f"<div><dt>{escape(entry.label)} {ARROWS[entry.better]}</dt><dd>{escape(entry.explanation)}</dd></div>"
        for entry in known
    )
    return f"<dl class=metrics>{items}</dl>"


def number(value: float | None, unit: str, signed: bool = False) -> str:
    """A number as tables print it: rates in percent with one digit, shares with three, the rest with three figures."""
    if value is None:
        return "–"
    sign = "+" if signed else ""
    if unit == "rate":
        text = f"{100 * value:{sign}.1f}"
    elif unit == "share":
        text = f"{value:{sign}.3f}"
    else:
        digits = 2 if abs(value) < 10 else 1 if abs(value) < 1000 else 0
        text = f"{value:{sign}.{digits}f}"
    if not any(digit in text for digit in "123456789"):
        text = text.lstrip("+-")
    return text.replace("-", "−")


def percent(unit: str) -> str:
    """The sign behind a mean: percent for rates."""
    return " %" if unit == "rate" else ""


def bounds(interval: Interval, unit: str, signed: bool = False) -> str:
    """The interval in words: ``low–high``, or ``low to high`` where signs would be confused with the dash.

    A bootstrap of values that are all alike has no width; the words say so instead of claiming certainty.
    """
    if interval.low is None or interval.high is None:
        return "no interval" if interval.n else ""
    if interval.low == interval.high:
        return "all alike"
    low, high = number(interval.low, unit, signed), number(interval.high, unit, signed)
    between = " to " if signed or "−" in low + high else "–"
    return f"{low}{between}{high}"


def _planner(run: Evaluation) -> str:
    name = escape(run.name).replace("_", "_<wbr>")
    return f"<th scope=row>{name}<small>{len(run)} episodes, {escape(run.traffic)} traffic</small></th>"


def _heading(metric: str, entry: Note, scope: str = "col") -> str:
    title = escape(entry.explanation or metric)
    arrow = {"up": "more is better", "down": "less is better", "none": ""}[entry.better]
    mark = f'<abbr title="{arrow}">{ARROWS[entry.better]}</abbr>' if arrow else ""
    return f'<th scope={scope} title="{title}">{escape(entry.label)} {mark}</th>'


def _cell(
    interval: Interval, entry: Note, best: float | None, behind: Mapping[str, Any] | None = None
) -> str:
    if interval.mean is None:
        return '<td class=undefined title="undefined in every episode">–<small>n 0</small></td>'
    mark = " class=best" if best is not None and interval.mean == best else ""
    mark += _behind(behind) if behind else ""
    mean = number(interval.mean, entry.unit) + percent(entry.unit)
    return f"<td{mark}><b>{mean}</b><small>{bounds(interval, entry.unit)}</small><small>n {interval.n}</small></td>"


def _behind(asked: Mapping[str, Any]) -> str:
    """The attribute that leads from a cell to the page's list of episodes."""
    return f' data-behind="{escape(json.dumps(asked))}"'


def _best(intervals: Sequence[Interval], entry: Note) -> float | None:
    """The best mean of a column, where there is a direction and a choice."""
    means = [interval.mean for interval in intervals if interval.mean is not None]
    if entry.better == "none" or len(means) < 2 or min(means) == max(means):
        return None
    return max(means) if entry.better == "up" else min(means)


def _difference_cell(policy: Evaluation, other: Evaluation, metric: str) -> str:
    if found := mismatch(policy, other):
        return f"<td class=undefined>no pairs: {escape(found[0])}</td>"
    compared: Difference = difference(policy, other, metric)
    if compared.interval.mean is None:
        return '<td class=undefined title="no scenario where both are defined">–<small>n 0</small></td>'
    unit = note(metric, [policy]).unit
    points = " points" if unit == "rate" else ""
    sign, words = _VERDICTS[compared.verdict]
    mean = number(compared.interval.mean, unit, signed=True) + points
    between = bounds(compared.interval, unit, signed=True)
    behind = _behind({"run": policy.name, "metric": metric})
    return (
        f"<td class={compared.verdict}{behind}><b>{mean}</b><em>{sign} {words}</em>"
        f"<small>{between}, n {compared.interval.n}</small></td>"
    )


def _scrolling(head: str, body: str, name: str) -> str:
    """A table that scrolls sideways by itself on narrow screens."""
    return (
        f'<div class=scroll tabindex=0 role=region aria-label="{name}"><table class={name}>{head}'
        f"<tbody>{body}</tbody></table></div>"
    )
