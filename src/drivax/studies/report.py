"""The report of a study: one HTML page from ``results.json`` and the score tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.curation.methods import ORACLES
from drivax.curation.scores import ScoreTable
from drivax.files import write_text
from drivax.metrics.catalogue import METRICS
from drivax.report.charts import histogram
from drivax.report.pages.page import page
from drivax.studies.definition import Stratum, StudyDefinition
from drivax.studies.verdicts import RELATED, UNRELATED, best_validation
from drivax.table import MISSING, Cell, Column, Table

_STRATA: Mapping[Stratum, str] = {
    "ordinary": "Ordinary traffic", "common": "Common scenarios", "rare": "Rare scenarios",
}  # fmt: skip
#: Methods whose most critical scenarios the player shows, and the number of each.
PLAYER_METHODS, PLAYER_TOP = ("kinematic", "ensemble", "action_rarity"), 3
_VERDICT_TEXTS = {"supported": "▲ supported", "contradicted": "▼ contradicted", "undecided": "undecided"}
#: Number of cells of the action map along each axis, its size, and the margins for its labels, in pixels.
_MAP_CELLS, _MAP_SIZE, _MAP_LEFT, _MAP_RIGHT, _MAP_BOTTOM = 48, 336, 30, 10, 30
_STYLE = """
.claims td, .claims th { text-align: left; }
.claims th[scope=row] { min-width: 19em; }
.claims td:last-child { min-width: 11em; }
.claims td:nth-child(n+3):nth-child(-n+6) { white-space: nowrap; }
.dense td, .dense th[scope=row] { white-space: nowrap; max-width: none; font-size: 0.85rem; }
h3 { margin-top: 1.5em; }
.map rect { stroke: none; }
.map text { font-size: 11px; fill: var(--soft); }
"""
Results = Mapping[str, Any]


def write_report(
    definition: StudyDefinition, results: Results, tables: Mapping[str, ScoreTable],
    actions: Float[np.ndarray, "n 2"], out: Path,
) -> None:  # fmt: skip
    """Write the report of a study.

    Args:
        definition: The study.
        results: Contents of ``results.json``.
        tables: Scores of the training set by method.
        actions: Actions of the experts in the training set, in units of the action space.
        out: The HTML file.
    """
    scored_tables = {name: table for name, table in tables.items() if name != "uniform"}
    rule = definition.checkpoints_by.rpartition("/")[2]
    sections = {
        "Before the comparison": _conditions(definition, results),
        "Verdicts": _verdicts(definition, results),
        "Evaluation of the arms": "".join(_rates(definition, results, stratum) for stratum in _STRATA)
        + _events(definition, results)
        + _critics(results),
        "Distribution of the sampling weights": draws_table(results).html(),
        "Are the methods different?": _rankings(results),
        f"Choosing checkpoints by the highest {rule}": _rule_cost(results, rule),
        "Scores": _scores(scored_tables),
        "Actions of the experts": _action_map(actions),
    }
    sections_html = [f"<section><h2>{escape(title)}</h2>{html}</section>" for title, html in sections.items()]
    write_text(out, page(definition.title, _lead(definition, results), sections_html, _STYLE))


def _lead(definition: StudyDefinition, results: Results) -> str:
    """Return the first paragraph: counts of verdicts, sizes, and a warning if a baseline is not good enough."""
    verdicts = [claim["verdict"] for claim in results["claims"]]
    counts = ", ".join(f"{verdicts.count(name)} {name}" for name in _VERDICT_TEXTS)
    about, warning = results["about"], ""
    if not all(arm["met"] for arm in results["conditions"] if arm["arm"] in definition.baselines):
        warning = (
            "<p><b>The conditions of the comparison are not met</b>: read its verdicts as those of arms that do not "
            "drive well.</p>"
        )
    return (
        f"<p class=lead>{len(verdicts)} claims: {counts}. {len(results['draws'])} arms, {about['seeds']} seeds, "
        f"{about['train']:,} training and {about['test']:,} test scenarios ({about['rare']:,} of them rare, "
        f"{'labelled' if about['labelled'] else 'by the kinematic heuristic'}).</p>{warning}"
    )


def _table(name: str, headings: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table of texts whose first column labels the rows; ``name`` is its CSS class."""
    columns = tuple(Column(heading, label=not index) for index, heading in enumerate(headings))
    return Table(name, columns, tuple(tuple(map(Cell, row)) for row in rows))


def _label(metric: str) -> str:
    return METRICS[metric].label or metric.replace("_", " ")


def _interval(value: float, bounds: Sequence[float], spec: str) -> str:
    low, high = bounds
    return f"{value:{spec}} [{low:{spec}}, {high:{spec}}]"


def conditions_table(results: Results) -> Table:
    """Return the validation results of every arm, and whether they are good enough (:class:`ValidationCheck`)."""
    rows = [
        (
            arm["arm"], f"{arm['progress']:.1%}", f"{arm['least']:.1%}", f"{arm['change']:+.3f}",
            f"{arm['moved']:.3f}", "yes" if arm["met"] else "no",
        )
        for arm in results["conditions"]
    ]  # fmt: skip
    return _table(
        "dense",
        ("arm", "progress ratio", "worst seed", "change of the score", "absolute change", "good enough"),
        rows,
    )


def detectable_table(results: Results) -> Table:
    """Return the smallest detectable differences."""
    rows = [(_label(name), f"{value:.3f}") for name, value in results["detectable"].items()]
    return _table("dense", ("metric", "smallest detectable difference"), rows)


def claims_table(results: Results, group: str) -> Table:
    """Return the verdicts on the claims of a group."""
    rows = [_claim_row(claim) for claim in results["claims"] if claim["claim"]["group"] == group]
    headings = ("claim", "metric", "difference", "relative", "adjusted p", "verdict", "what would decide")
    return _table("claims", headings, rows)


def _claim_row(result: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the cells of a claim, from :meth:`ClaimResult.plain`; undefined values are empty."""
    claim, interval, change, p = (result[name] for name in ("claim", "interval", "change", "adjusted"))
    slower, words = result.get("slower_arm"), claim["words"]
    if claim.get("margin") is not None:
        words += f" (margin {claim['margin']:g})"
    if slower is not None:
        words += f" ({slower[0]} at {slower[1]:.2f} of the speed limit)"
    return (
        words,
        _label(claim["metric"]),
        "" if interval is None else _interval(result["difference"], interval, "+.3f"),
        "" if change is None else _interval(change[0], change[1:], "+.0%"),
        "" if p is None else f"{p:.3f}".replace("0.000", "<0.001"),
        _VERDICT_TEXTS[result["verdict"]],
        result["needed"],
    )


def rates_table(results: Results, stratum: Stratum) -> Table:
    """Return the means of every arm in a stratum of scenarios."""
    arms = {name: rates[stratum] for name, rates in results["rates"].items() if stratum in rates}
    metrics = list(dict.fromkeys(metric for rates in arms.values() for metric in rates))
    unhealthy = {arm for arm, seeds in results.get("critics", {}).items() if any(seeds)}
    rows = [
        (
            f"{name} (unhealthy critics)" if name in unhealthy else name,
            *(_rate(rates[metric]) if metric in rates else "" for metric in metrics),
        )
        for name, rates in arms.items()
    ]
    return _table("dense", ("arm", *map(_label, metrics)), rows)


def _rate(rate: Mapping[str, float]) -> str:
    return _interval(rate["mean"], (rate["low"], rate["high"]), ".3f")


def events_table(results: Results) -> Table:
    """Return the mean of the study's first metric in scenarios with each kind and severity of event, by arm."""
    by_arm = results.get("events", {})
    groups = list(dict.fromkeys(group for rates in by_arm.values() for group in rates))
    rows = [
        (name, *(_rate(rates[group]) if group in rates else "" for group in groups))
        for name, rates in by_arm.items()
        if rates
    ]
    return _table("dense", ("arm", *groups), rows)


def critics_table(results: Results) -> Table:
    """Return the number of seeds with healthy critics of each arm with critics, and the problems of the others."""
    checked = {
        arm: [problems for problems in seeds if problems is not None]
        for arm, seeds in results.get("critics", {}).items()
    }
    rows = [
        (
            arm,
            f"{sum(not problems for problems in seeds)} of {len(seeds)}",
            "; ".join(dict.fromkeys(chain(*seeds))),
        )
        for arm, seeds in checked.items()
        if seeds
    ]
    return _table("claims", ("arm", "healthy critics", "problems of the others"), rows)


def draws_table(results: Results) -> Table:
    """Return the distribution of the sampling weights of every arm (permuted arms: with seed 0)."""
    names = ("effective", "effective_scenarios", "tilt", "largest", "concentration")
    headings = ("arm", "effective sample", "of scenarios", "tilt", "largest", "draws from 5 %")
    rows = [(arm, *(f"{draws[name]:.2f}" for name in names)) for arm, draws in results["draws"].items()]
    return _table("dense", headings, rows)


def rankings_table(results: Results) -> Table:
    """Return the similarity of the methods' rankings of scenarios."""
    rows = [
        (
            " and ".join(pair["methods"]),
            MISSING if pair["rho"] is None else _interval(pair["rho"], pair["interval"], "+.2f"),
            f"{pair['overlap']:.0%}",
            _VERDICT_TEXTS[pair["orthogonal"]],
        )
        for pair in results["rankings"]
    ]
    headings = ("methods", "rank correlation", "same among the top 5 %", "“they are orthogonal”")
    return _table("rankings", headings, rows)


def rule_cost_table(results: Results, rule: str) -> Table:
    """Return the cost of choosing checkpoints by the highest ``rule``."""
    rows = [
        (_label(name), _interval(cost["difference"], cost["interval"], "+.3f"))
        for name, cost in results["rule_cost"].items()
    ]
    return _table("costs", ("metric", f"by {rule} minus by validation score"), rows)


def validations_table(results: Results, rule: str) -> Table:
    """Return the first baseline's ``rule`` and score at each validation, and for how many seeds each chooses it."""
    curves = {
        name: np.array([seed[key] for seed in results["validations"]], np.float64)
        for name, key in ((rule, "rule"), ("score", "score"))
    }
    validations = range(curves["score"].shape[1])
    rows = [
        (f"{name}, mean over seeds", *(MISSING if np.isnan(x) else f"{x:.3f}" for x in values.mean(axis=0)))
        for name, values in curves.items()
    ]
    best = {
        rule: np.nanargmax(curves[rule], axis=1),
        "score": np.array([best_validation(scores) for scores in curves["score"]]),
    }
    rows += [
        (f"seeds with their highest {name}", *(str((best_of_seed == k).sum()) for k in validations))
        for name, best_of_seed in best.items()
    ]
    return _table("dense", ("validation", *(str(k + 1) for k in validations)), rows)


def _conditions(definition: StudyDefinition, results: Results) -> str:
    baselines = escape(" and ".join(definition.baselines))
    differences = ", ".join(f"{_label(name)} {value:.3f}" for name, value in results["detectable"].items())
    return conditions_table(results).html() + (
        "<p>Progress is relative to the expert's, at the best checkpoint. The change of the score is from the third to "
        "the last quarter of the validations. Smallest differences in ordinary traffic that this study detects with a "
        "power of 80 %, at the strictest level of the first group of claims, if all seeds vary like the baseline's: "
        f"{escape(differences)}. {baselines} had to be good enough before the other arms were trained, unless --anyway "
        "was passed.</p>"
    )


def _verdicts(definition: StudyDefinition, results: Results) -> str:
    groups = {heading: claims_table(results, group) for group, heading in definition.groups.items()}
    return "".join(
        f"<h3>{escape(heading)}</h3>{table.html()}" for heading, table in groups.items() if table.rows
    ) + (
        "<p><small>Differences are means over seeds and scenarios with 95 % intervals; both seeds and recordings are "
        "random (Welch-Satterthwaite). P-values are adjusted for the number of claims in their group (Holm). A claim "
        "is supported or contradicted below 0.05, otherwise undecided; the number of seeds or recordings that would "
        "decide supposes that the difference is the estimated one, at the strictest level of its group. A claim about "
        "a size is tested against that size; one with a margin, against being worse by the margin. At equal progress, "
        "the arm that gets further drives slower until it does not. Compare the weights of a method and of its control "
        "in the table of weights. Scores are computed once: claims are about these scores, at this strength of "
        "weighting.</small></p>"
    )


def _rates(definition: StudyDefinition, results: Results, stratum: Stratum) -> str:
    """Return the section of a stratum; empty if there are no results."""
    table, share = rates_table(results, stratum), results["about"]["share"]
    if not table.rows:
        return ""
    note = ""
    if stratum == "ordinary" and share is not None:
        text = f"Scenarios with an event are weighted by their share of ordinary traffic, {share:.1%}."
        note = f"<p><small>{text}</small></p>"
    return f"<h3>{_STRATA[stratum]}</h3>{table.html()}{note}"


def _events(definition: StudyDefinition, results: Results) -> str:
    """Return the section of kinds and severities of events; empty if there are no labels."""
    table = events_table(results)
    return f"<h3>Events: {escape(_label(definition.metrics[0]))}</h3>{table.html()}" if table.rows else ""


def _critics(results: Results) -> str:
    """Return the section of the critics' checks; empty if there are none."""
    table = critics_table(results)
    note = "<p><small>An arm is called unhealthy if the critics of one of its seeds fail a check.</small></p>"
    return f"<h3>Health of the critics</h3>{table.html()}{note}" if table.rows else ""


def _rankings(results: Results) -> str:
    return rankings_table(results).html() + (
        "<p><small>Of the scores of the training scenarios, with 95 % intervals over recordings. “They are orthogonal” "
        f"is supported if the interval is within ±{UNRELATED}, contradicted if it is beyond ±{RELATED}. "
        "Two random rankings have 5 % of their top 5 % in common.</small></p>"
    )


def _rule_cost(results: Results, rule: str) -> str:
    seeds = results["validations"]
    best = [int(np.nanargmax(np.array(seed["rule"], np.float64))) for seed in seeds]
    agreements = sum(k == best_validation(seed["score"]) for k, seed in zip(best, seeds, strict=True))
    return (
        f"{rule_cost_table(results, rule).html()}<p><small>Test results of the baseline's checkpoints with the highest "
        f"{escape(rule)}, minus those of the checkpoints with the best validation score, paired by seed. "
        f"Both rules choose the same checkpoint for {agreements} of the {len(seeds)} seeds.</small></p>"
        f"{validations_table(results, rule).html()}"
    )


def _scores(tables: Mapping[str, ScoreTable]) -> str:
    """Return histograms of the scores and the three most critical scenarios of each method."""
    charts = "".join(
        histogram(f"{name}: scores of scenarios", {name: table.scenarios}, "score")
        for name, table in tables.items()
    )
    top_rows = [
        (name, *(table.scenario_ids[row] for row in table.order[:PLAYER_TOP]))
        for name, table in tables.items()
        if name not in ORACLES  # labels do not rank scenarios
    ]
    shown = " and ".join(name for name in PLAYER_METHODS if name in tables)
    link = f"<p>Play those of {shown} in <a href=critical.html>critical.html</a>.</p>" if shown else ""
    return (
        f"<div class=charts>{charts}</div>"
        + _table("dense", ("method", "most critical", "second", "third"), top_rows).html()
        + link
    )


def _action_map(actions: Float[np.ndarray, "n 2"]) -> str:
    """Return a map of the frequencies of actions: steering along x, acceleration along y, both from -1 to 1."""
    counts, _, _ = np.histogram2d(actions[:, 0], actions[:, 1], bins=_MAP_CELLS, range=((-1, 1), (-1, 1)))
    opacity = np.log1p(counts) / np.log1p(counts.max())
    side = _MAP_SIZE / _MAP_CELLS
    cells = "".join(
        f'<rect x="{_MAP_LEFT + column * side:.1f}" y="{(_MAP_CELLS - 1 - row) * side:.1f}" width="{side:.1f}" '
        f'height="{side:.1f}" fill="var(--ink)" fill-opacity="{opacity[row, column]:.2f}"/>'
        for row, column in np.argwhere(counts > 0)
    )
    return (
        f'<figure class="chart map"><figcaption>Frequency of the experts\' actions<small>logarithmic; '
        f"{len(actions):,} steps</small></figcaption>"
        f'<svg viewBox="0 0 {_MAP_LEFT + _MAP_SIZE + _MAP_RIGHT} {_MAP_SIZE + _MAP_BOTTOM}" role="img" '
        f'aria-label="map of actions">{cells}'
        f'<text x="{_MAP_LEFT + _MAP_SIZE / 2:.0f}" y="{_MAP_SIZE + 20}" text-anchor="middle">'
        "steering, left is positive</text>"
        f'<text transform="translate(18 {_MAP_SIZE / 2:.0f}) rotate(-90)" text-anchor="middle">acceleration</text>'
        "</svg></figure>"
    )
