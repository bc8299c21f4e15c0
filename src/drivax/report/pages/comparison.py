"""A comparison of two planners as text and as one self-contained HTML page: recommendation, reasons, and numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from html import escape
from importlib import metadata
from pathlib import Path

from drivax import settings
from drivax.escaping import escape_controls
from drivax.evaluation.comparison import Comparison, MetricComparison
from drivax.evaluation.result_tables import MetricLabel, metric_label
from drivax.files import check_output, write_text
from drivax.report.pages.page import asset, facts_html, page, section
from drivax.table import MISSING, Cell, Column, Table, bounds, interval_cell, number, suffix

#: Size of the picture of a difference, pixels.
_WIDTH, _HEIGHT = 180, 34


def comparison_text(comparison: Comparison) -> str:
    """Return a comparison as text: planners, conditions, tables of at most 100 columns, recommendation and notes."""
    tables = comparison_tables(comparison)
    arms = zip("AB", comparison.names, comparison.folders, strict=True)
    lines = [escape_controls(f"{arm}  {name}  ({folder or 'in memory'})") for arm, name, folder in arms]
    lines += [conditions(comparison), "", tables[0].text(*tables[1:]), ""]
    lines += [f"recommendation: {title(comparison)}", *(f"  {reason}" for reason in reasons(comparison))]
    return "\n".join([*lines, *(f"  ({note})" for note in notes(comparison))])


def comparison_tables(comparison: Comparison, arms: tuple[str, str] = ("A", "B")) -> list[Table]:
    """Return the tables of the primary metric and, if there are any, of the secondary metrics."""
    tables = [_table(comparison, arms, "primary metric", "p", [comparison.primary])]
    if secondary := list(comparison.secondary):
        tables.append(_table(comparison, arms, "secondary metrics", "p (Holm)", secondary))
    return tables


def _table(
    comparison: Comparison, arms: tuple[str, str], name: str, p_heading: str, metrics: list[MetricComparison]
) -> Table:
    """Return a row per metric; ``name`` heads the metrics, ``p_heading`` their p-values."""
    columns = (
        Column(name, label=True), *map(Column, arms), Column("A − B"),
        Column("next to zero", picture=True), Column(effect_name(comparison)), Column(p_heading), Column("n"),
        Column("better"),
    )  # fmt: skip
    return Table(name, columns, tuple(map(_row, metrics)))


def _row(metric: MetricComparison) -> tuple[Cell, ...]:
    label = _label(metric)
    effects = ", ".join(f"{name} {value:.3f}" for name, value in metric.effects.items() if value is not None)
    value = metric.effects.get("d_z", metric.effects.get("d"))
    intervals = ((metric.a, False), (metric.b, False), (metric.difference, True))
    cells = (interval_cell(interval, label.unit, metric.metric, signed) for interval, signed in intervals)
    return (
        Cell(label.heading, title=label.title or metric.metric),
        *(replace(cell, note="", style="", title="") for cell in cells),  # n has a column of its own
        Cell("", html=_picture(metric, label)),
        Cell(MISSING if value is None else f"{value:+.2f}".replace("-", "−"), title=effects),
        Cell(_p_text(metric.p_adjusted), note=_test_name(metric)), Cell(f"{metric.difference.n:,}"),
        Cell(metric.winner or MISSING),
    )  # fmt: skip


def _picture(metric: MetricComparison, label: MetricLabel) -> str:
    """Return the interval of the difference around zero as SVG, or "" without one; on the right, A is higher."""
    mean, low, high = metric.difference.mean, metric.difference.low, metric.difference.high
    if mean is None or low is None or high is None or low == high:
        return ""
    limit = 1.15 * max(abs(low), abs(high))  # a margin of 15 %
    left, middle, right = (_WIDTH / 2 * (1 + value / limit) for value in (low, mean, high))
    label_text = f"A − B: {number(mean, label.unit, signed=True)}, {bounds(metric.difference, label.unit, signed=True)}"
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label_text)}">'
        f'<line x1="{_WIDTH / 2}" x2="{_WIDTH / 2}" y1="2" y2="22"/>'
        f'<line class="span" x1="{left:.1f}" x2="{right:.1f}" y1="12" y2="12"/>'
        f'<circle cx="{middle:.1f}" cy="12" r="4"/>'
        f'<text x="{_WIDTH / 2}" y="32" text-anchor="middle">0</text></svg>'
    )


def _label(metric: MetricComparison) -> MetricLabel:
    """Return the label of a metric; user-defined metrics keep their names and units."""
    label = metric_label(metric.metric)
    if label.explanation or not metric.unit:
        return label
    dimensionless = metric.unit == "-"
    text = label.text if dimensionless else f"{label.text} [{metric.unit}]"
    return MetricLabel(text, metric.better, "share" if dimensionless else metric.unit, "")


def _p_text(p: float | None) -> str:
    """Format a p-value with three decimals, or as ``< 0.001``."""
    if p is None:
        return MISSING
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def effect_name(comparison: Comparison) -> str:
    """Return the name of the effect size: ``d_z`` of paired, ``d`` of separate scenarios."""
    return "d_z" if "d_z" in comparison.primary.effects else "d"


def conditions(comparison: Comparison) -> str:
    """Describe the scenarios and the traffic of a comparison."""
    (a, b), (recordings_a, recordings_b) = comparison.scenarios, comparison.recordings
    traffic = f"{comparison.traffic} traffic"
    if comparison.plan.split == "paired":
        return f"paired on {a:,} scenarios of {recordings_a:,} recordings, {traffic}"
    strata = "stratum" if comparison.strata == 1 else "strata"
    kind = "at random" if comparison.plan.split == "random" else f"within {comparison.strata} {strata}"
    return (
        f"split {kind}: {a:,} scenarios of {recordings_a:,} recordings for A, {b:,} of {recordings_b:,} for B, "
        f"{traffic}"
    )


def _test_name(metric: MetricComparison) -> str:
    """Return the name of the test with the number of its units, or with ``exact`` or ``by recording``."""
    evidence = metric.evidence
    if evidence.name.startswith("McNemar"):
        return f"{evidence.name}, {evidence.units:,} discordant pairs"
    if metric.seeds > 1:
        return f"{evidence.name} test over seeds and {evidence.units:,} recordings"
    return f"{evidence.name} test, {'exact' if evidence.exact else 'by recording'}"


def title(comparison: Comparison) -> str:
    """Return the recommendation in a few words."""
    kind = comparison.decision.recommendation
    return f"{kind} ({comparison.names['AB'.index(kind)]})" if kind in ("A", "B") else kind


def reasons(comparison: Comparison) -> list[str]:
    """Return the reasons for the recommendation in full sentences."""
    decision, n = comparison.decision, f"{comparison.primary.difference.n:,}"
    sentences = [_test_sentence(comparison)]
    if decision.because == "minimum":
        minimum = f"{comparison.plan.minimum_scenarios:,}"
        sentences.insert(0, f"{n} scenarios count, and the plan asks for at least {minimum}.")
    if decision.because == "seeds":
        sentences.append("Seeds differ so much that more scenarios do not help: more seeds are needed.")
    if decision.because == "equal":
        equality = "the same for A and B in each" if comparison.plan.split == "paired" else "the same in all"
        sentences = [f"{_label(comparison.primary).text} is {equality} of {n} scenarios."]
    sentences += _power_sentences(comparison)
    if decision.caveats:
        names = ", ".join(metric_label(name).text for name in decision.caveats)
        other = "B" if decision.recommendation == "A" else "A"
        sentences.append(f"But {other} is better in: {names}.")
    return [sentence[:1].upper() + sentence[1:] for sentence in sentences]


def _test_sentence(comparison: Comparison) -> str:
    """Return the result of the test of the primary metric."""
    metric, label = comparison.primary, _label(comparison.primary)
    if metric.difference.mean is None or metric.evidence.p is None:
        return f"{label.text} cannot be tested: it is defined in fewer than two recordings."
    p = _p_text(metric.evidence.p)
    p_sentence = f"p {p}" if p.startswith("<") else f"p = {p}"
    test = f"{bounds(metric.difference, label.unit, signed=True)}, {p_sentence}"
    if metric.difference.mean == 0.0:
        return f"{label.text} has the same mean for A and B ({test})."
    size = number(abs(metric.difference.mean), label.unit) + suffix(label.unit, signed=True)
    direction = "higher" if metric.difference.mean > 0 else "lower"
    if metric.winner is None:
        return f"{label.text} is {size} {direction} with A ({test}): it may be chance."
    note = f" The test alone favours {metric.winner}." if comparison.decision.because == "minimum" else ""
    return f"{label.text} is {size} {direction} with A ({test}).{note}"


def _power_sentences(comparison: Comparison) -> list[str]:
    """Return the detectable difference and the number of scenarios needed."""
    sensitivity, count = comparison.sensitivity, comparison.decision.needed
    if sensitivity is None:
        return []
    unit = _label(comparison.primary).unit
    sentences = []
    if sensitivity.detectable is not None:
        size = number(sensitivity.detectable, unit) + suffix(unit, signed=True)
        power = f"{100 * comparison.plan.power:.0f} %"
        sentences.append(f"A difference of {size} would be detected in {power} of such comparisons.")
    if count is not None:
        size = number(sensitivity.smallest, unit) + suffix(unit, signed=True)
        sentences.append(f"{count:,} scenarios are needed; the smallest difference that matters is {size}.")
    return sentences


def notes(comparison: Comparison) -> list[str]:
    """Return notes on undefined values and on seeds."""
    lines = []
    for metric in (comparison.primary, *comparison.secondary):
        if metric.undefined_a or metric.undefined_b:
            counts = f"undefined for A in {metric.undefined_a:,}, for B in {metric.undefined_b:,} scenarios"
            lines.append(f"{_label(metric).text}: {counts}")
    unit = _label(comparison.primary).unit
    for arm, name, seeds in zip("AB", comparison.names, comparison.seeds, strict=True):
        if seeds is not None:
            means = ", ".join(number(mean, unit) for mean in seeds.means)
            iqm = f"{number(seeds.interquartile.mean, unit)} ({bounds(seeds.interquartile, unit)})"
            lines.append(f"{arm}, {name}: {len(seeds.means)} seeds: {means}; interquartile mean {iqm}")
    if any(comparison.seeds):
        lines.append("seeds are averaged per scenario; intervals and the test hold for other seeds, too")
    return lines


def write_comparison(comparison: Comparison, out: Path, overwrite: bool = False) -> Path:
    """Write the page of a comparison to the HTML file ``out``.

    Raises:
        UsageError: ``out`` exists without ``overwrite``, or is a folder.
    """
    check_output(out, overwrite)
    names = f"{comparison.names[0]} against {comparison.names[1]}"
    label = f"{comparison.plan.name}: " if comparison.plan.name else ""
    sections = [_metrics(comparison), _plan(comparison), _origin(comparison)]
    write_text(out, page(f"{label}{names}", _lead(comparison), sections, asset("comparison.css")))
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
    confidence, level = f"{100 * comparison.plan.confidence:.0f} %", f"{1 - comparison.plan.confidence:.2g}"
    effect = "d, with the pooled standard deviation"
    if effect_name(comparison) == "d_z":
        effect = "d_z, the mean of the differences over their standard deviation"
    interval = "over seeds and recordings"
    if comparison.primary.seeds == 1:
        interval = "(Wilson's for rates of A and B, else a bootstrap over recordings)"
    note = (
        f"Mean and {confidence} interval {interval}. n: scenarios where the metric is defined. "
        f"Effect size: Cohen's {effect}. A planner is called better if the two-sided p-value is below {level}; "
        "p-values of secondary metrics are adjusted for their number by Holm's method."
    )
    return section("Metrics", tables, f"<ul>{items}</ul>" if items else "", note=note)


def _plan(comparison: Comparison) -> str:
    plan = comparison.plan
    return section(
        "The rule",
        f"<p>With fewer than {plan.minimum_scenarios:,} scenarios there is no verdict. If the p-value is below "
        f"{1 - plan.confidence:.2g}, the verdict is the better planner. Otherwise it is no difference if all values "
        f"are equal or the comparison had a power of {100 * plan.power:.0f} % to detect the smallest difference that "
        "matters, and not enough scenarios if it had less.</p>"
        f"<details><summary>the plan</summary><pre>{escape(settings.dump(plan))}</pre></details>",
    )


def _origin(comparison: Comparison) -> str:
    arms = zip("AB", comparison.names, comparison.folders, strict=True)
    rows = [(f"{arm}: {name}", [str(folder or "in memory")]) for arm, name, folder in arms]
    numbers = escape(json.dumps(comparison.as_dict(), indent=1, ensure_ascii=False))
    return section(
        "How this was made",
        facts_html(["", ""], rows),
        f"<details><summary>all numbers</summary><pre>{numbers}</pre></details>",
        note=f"drivax {escape(metadata.version('drivax'))}. Every number comes from the episodes.csv of the runs.",
    )
