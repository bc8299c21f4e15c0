"""A comparison of two planners in words: its recommendation, and tables for a terminal of 100 columns."""

from __future__ import annotations

from collections.abc import Sequence

from drivax.evaluation.comparison import Comparison
from drivax.evaluation.decision import MetricComparison
from drivax.report.glossary import ARROWS, Note, note
from drivax.report.html_tables import bounds, number, percent
from drivax.stats.intervals import Interval

_ARROWS = {"high": ARROWS["up"], "low": ARROWS["down"], "-": ARROWS["none"]}


def metric_note(one: MetricComparison) -> Note:
    """How a metric is shown; those of the user's own under their names, with their units."""
    known = note(one.metric)
    if known.explanation or not one.unit:
        return known
    plain = one.unit == "-"
    label = known.label if plain else f"{known.label} [{one.unit}]"
    return Note(label, known.better, "share" if plain else one.unit, "")


def heading(one: MetricComparison) -> str:
    """Name of a metric with an arrow to where it is better."""
    return f"{metric_note(one).label} {_ARROWS.get(one.better, '')}".rstrip()


def p_value(p: float | None) -> str:
    """A p-value with three digits; below 0.001 that it is."""
    return "–" if p is None else "< 0.001" if p < 0.001 else f"{p:.3f}"


def effect(one: MetricComparison) -> str:
    """The main effect size: ``d_z`` of pairs, ``d`` of a split."""
    value = one.effects.get("d_z", one.effects.get("d"))
    return "–" if value is None else f"{value:+.2f}".replace("-", "−")


def effect_name(found: Comparison) -> str:
    """How the main effect size is called."""
    return "d_z" if "d_z" in found.primary.effects else "d"


def conditions(found: Comparison) -> str:
    """What was compared: which scenarios, in which traffic."""
    (a, b), (mine, theirs) = found.scenarios, found.recordings
    traffic = f"{found.traffic} traffic"
    if found.plan.split == "paired":
        return f"paired on {a:,} scenarios of {mine:,} recordings, {traffic}"
    strata = "stratum" if found.strata == 1 else "strata"
    kind = "at random" if found.plan.split == "random" else f"within {found.strata} {strata}"
    return f"split {kind}: {a:,} scenarios of {mine:,} recordings for A, {b:,} of {theirs:,} for B, {traffic}"


def how_tested(one: MetricComparison) -> str:
    """The test behind a p-value."""
    if one.evidence.name.startswith("McNemar"):
        return f"{one.evidence.name}, {one.evidence.units:,} discordant pairs"
    if one.seeds > 1:
        return f"{one.evidence.name} test over seeds and {one.evidence.units:,} recordings"
    extent = "every sign counted" if one.evidence.exact else "drawn by recordings"
    return f"{one.evidence.name} test, {extent}"


def title(found: Comparison) -> str:
    """The recommendation in a few words."""
    kind = found.decision.recommendation
    return f"{kind} ({found.names['AB'.index(kind)]})" if kind in ("A", "B") else kind


def reasons(found: Comparison) -> list[str]:
    """Why, in full sentences."""
    one, decision = found.primary, found.decision
    told = [_tested(found)]
    if decision.because == "minimum":
        wanted = f"{found.plan.minimum_scenarios:,}"
        told.insert(0, f"{one.difference.n:,} scenarios count, and the plan asks for at least {wanted}.")
    if decision.because == "seeds":
        told.append("Seeds differ so much that no number of scenarios would tell: it takes more seeds.")
    if decision.because == "alike":
        same = "the same for A and B in each" if found.plan.split == "paired" else "the same in all"
        told = [f"{metric_note(one).label} is {same} of {one.difference.n:,} scenarios."]
    told += _power(found)
    if decision.caveats:
        names = ", ".join(note(name).label for name in decision.caveats)
        other = "B" if decision.recommendation == "A" else "A"
        told.append(f"But {other} is better in: {names}.")
    return [sentence[:1].upper() + sentence[1:] for sentence in told]


def _tested(found: Comparison) -> str:
    """What the test of the primary metric says."""
    one, entry = found.primary, metric_note(found.primary)
    if one.difference.mean is None or one.evidence.p is None:
        return f"{entry.label} cannot be tested: it takes two recordings at least."
    p = p_value(one.evidence.p)
    how = f"{bounds(one.difference, entry.unit, signed=True)}, p {p if p[0] == '<' else '= ' + p}"
    size = number(abs(one.difference.mean), entry.unit) + (" points" if entry.unit == "rate" else "")
    more = "higher" if one.difference.mean > 0 else "lower"
    if one.winner is None:
        return f"{entry.label} is {size} {more} with A ({how}): it may be chance."
    alone = "" if found.decision.because != "minimum" else f" The test alone would say {one.winner}."
    return f"{entry.label} is {size} {more} with A ({how}).{alone}"


def _power(found: Comparison) -> list[str]:
    """What could have been seen, and how many scenarios it takes."""
    seen, plan, entry = found.sensitivity, found.plan, metric_note(found.primary)
    if seen is None:
        return []
    unit = " points" if entry.unit == "rate" else ""
    smallest = number(seen.smallest, entry.unit) + unit
    told = []
    if seen.detectable is not None:
        least = number(seen.detectable, entry.unit) + unit
        told.append(
            f"A difference of {least} would be found in {100 * plan.power:.0f} % of such comparisons."
        )
    if found.decision.needed is not None:
        told.append(
            f"{found.decision.needed:,} scenarios are needed; the smallest difference that matters is {smallest}."
        )
    return told


def notes(found: Comparison) -> list[str]:
    """What a reader should know about the numbers."""
    told = []
    for one in (found.primary, *found.secondary):
        if one.undefined_a or one.undefined_b:
            label = metric_note(one).label
            told.append(
                f"{label}: undefined for A in {one.undefined_a:,}, for B in {one.undefined_b:,} scenarios"
            )
    for arm, name, spread in zip("AB", found.names, found.seeds, strict=True):
        if spread is not None:
            unit = metric_note(found.primary).unit
            means = ", ".join(number(mean, unit) for mean in spread.means)
            middle = f"{number(spread.interquartile.mean, unit)} ({bounds(spread.interquartile, unit)})"
            told.append(f"{arm}, {name}: {len(spread.means)} seeds: {means}; interquartile mean {middle}")
    if any(found.seeds):
        told.append("seeds are averaged per scenario; intervals and the test hold for other seeds, too")
    return told


def comparison_text(found: Comparison) -> str:
    """A comparison as text of at most 100 columns, the recommendation last."""
    lines = [f"A  {found.names[0]}  ({found.folders[0]})", f"B  {found.names[1]}  ({found.folders[1]})"]
    lines += [conditions(found), ""]
    rows = [_row(found.primary)]
    head = ["primary metric", "A", "B", "A − B", effect_name(found), "p", "n", "better"]
    parts = [(head, rows)]
    if found.secondary:
        parts.append(
            (["secondary metrics", *head[1:5], "p (Holm)", *head[6:]], [*map(_row, found.secondary)])
        )
    widths = [
        max(len(row[place]) for top, body in parts for lines_ in (*body, (top,)) for row in lines_)
        for place in range(len(head))
    ]
    for top, body in parts:
        lines += [_line(top, widths), *(_line(line, widths) for row in body for line in row), ""]
    lines += [f"recommendation: {title(found)}", *(f"  {reason}" for reason in reasons(found))]
    lines += [f"  ({one})" for one in notes(found)]
    return "\n".join(lines)


def _row(one: MetricComparison) -> tuple[list[str], list[str]]:
    """Two lines: means, and their intervals below."""
    unit = metric_note(one).unit

    def mean(interval: Interval, signed: bool = False) -> str:
        return number(interval.mean, unit, signed) + (
            "" if signed or interval.mean is None else percent(unit)
        )

    first = [
        heading(one),
        mean(one.a),
        mean(one.b),
        mean(one.difference, signed=True),
        effect(one),
        p_value(one.p_adjusted),
        f"{one.difference.n:,}",
        one.winner or "–",
    ]
    spans = [bounds(one.a, unit), bounds(one.b, unit), bounds(one.difference, unit, signed=True)]
    return first, ["", *spans, "", "", "", ""]


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    left, *rest = (
        f"{cell:<{width}}" if place == 0 else f"{cell:>{width}}"
        for place, (cell, width) in enumerate(zip(cells, widths, strict=True))
    )
    return "  ".join([left, *rest]).rstrip()
