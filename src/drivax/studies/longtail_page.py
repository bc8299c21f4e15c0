"""The report of a long-tail study: one HTML page, made of ``results.json`` and of the score tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.curation.scores import ScoreTable
from drivax.files import write_text
from drivax.report.charts import histogram
from drivax.report.pages.page import page
from drivax.studies.longtail_drives import FIRST
from drivax.studies.longtail_results import METRICS, RELATED, UNRELATED

_SHORT = {
    "collision": "collision", "at_fault_collision": "at fault", "offroad": "off-road", "accuracy": "accuracy",
    "progress_ratio": "progress", "vmax_score": "vmax score",
}  # fmt: skip
_KINDS = {"ordinary": "Ordinary traffic", "common": "Common scenarios", "rare": "Rare scenarios"}
_GROUPS = {
    "baseline": "Better than the baseline?",
    "control": "Better than the matched random control?",
    "where": "In common, and in rare scenarios?",
    "failures": "Fewer failures of any kind?",
    "methods": "One method better than another?",
}
_SIGNS = {"supported": "▲ supported", "contradicted": "▼ contradicted", "undecided": "undecided"}
#: Cells of the map of actions along either dimension, and its size in pixels.
_CELLS, _SIZE = 48, 336
_STYLE = """
table.wide td, table.wide th { text-align: left; }
table.wide th[scope=row] { min-width: 19em; }
table.wide td:last-child { min-width: 11em; }
table.dense td, table.dense th[scope=row] { white-space: nowrap; max-width: none; font-size: 0.85rem; }
table.wide td:nth-child(n+3):nth-child(-n+6) { white-space: nowrap; }
h3 { margin-top: 1.5em; }
.map rect { stroke: none; }
.map text { font-size: 11px; fill: var(--soft); }
"""

Actions = Float[np.ndarray, "n 2"]


def write_page(
    results: Mapping[str, Any], tables: Mapping[str, ScoreTable], actions: Actions, out: Path
) -> None:
    """Writes the report.

    Args:
        results: What the study found (``results.json``).
        tables: Scores of the training set by method.
        actions: What experts do there, in units of the action space.
        out: The HTML file.
    """
    scored = {name: table for name, table in tables.items() if name != "uniform"}
    sections = [
        _section("Before the comparison", _conditions(results)),
        _section("Verdicts", _verdicts(results)),
        _section("How the arms evaluated", "".join(_rates(results, kind) for kind in _KINDS)),
        _section("How the weights lie", _table(*draws(results), "dense")),
        _section("Are the methods different?", _rankings(results)),
        _section("Choosing checkpoints by the highest mean Q", _mean_q(results)),
        _section("Scores", _scores(scored)),
        _section("Actions of the experts", _action_map(actions)),
    ]
    write_text(out, page("The long-tail study", _lead(results), sections, _STYLE))


def _lead(results: Mapping[str, Any]) -> str:
    verdicts = [one["verdict"] for one in results["claims"]]
    counts = ", ".join(f"{verdicts.count(name)} {name}" for name in _SIGNS)
    about = results["about"]
    gate = [one["met"] for one in results["conditions"] if one["arm"] in FIRST]
    caution = "" if all(gate) else (
        "<p><b>The conditions of the comparison are not met</b>: read its verdicts as those of arms that do not "
        "drive well.</p>"
    )  # fmt: skip
    return (
        f"<p class=lead>{len(verdicts)} claims: {counts}. {len(results['draws'])} arms, {about['seeds']} seeds, "
        f"{about['train']:,} training and {about['test']:,} test scenarios ({about['rare']:,} of them rare, "
        f"{'labelled' if about['labelled'] else 'by the kinematic heuristic'}).</p>{caution}"
    )


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    head = "".join(f"<th scope=col>{escape(one)}</th>" for one in heads)
    body = "".join(
        "<tr>"
        + f"<th scope=row>{escape(row[0])}</th>"
        + "".join(f"<td>{escape(c)}</td>" for c in row[1:])
        + "</tr>"
        for row in rows
    )
    return f"<div class=scroll><table class='{kind}'><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


#: Heads and rows of a table.
Cells = tuple[Sequence[str], Sequence[Sequence[str]]]


def conditions(results: Mapping[str, Any]) -> Cells:
    """How well every arm drives before the test, and whether it no longer learns."""
    rows = [
        (
            one["arm"],
            f"{one['progress']:.1%}",
            f"{one['least']:.1%}",
            f"{one['change']:+.3f}",
            f"{one['moved']:.3f}",
            "yes" if one["met"] else "no",
        )
        for one in results["conditions"]
    ]
    heads = (
        "arm", "progress of the expert's", "worst seed", "score, third to last quarter", "either way", "good enough"
    )  # fmt: skip
    return heads, rows


def verdicts(results: Mapping[str, Any], group: str) -> Cells:
    """What became of the claims of a group."""
    rows = [_verdict(one) for one in results["claims"] if one["claim"]["group"] == group]
    return ("claim", "metric", "difference", "relative", "adjusted p", "verdict", "what would decide"), rows


def rates(results: Mapping[str, Any], kind: str) -> Cells:
    """How every arm evaluated scenarios of a kind."""
    found = {name: rates[kind] for name, rates in results["rates"].items() if kind in rates}
    metrics = [name for name in METRICS if any(name in rates for rates in found.values())]
    rows = [(name, *(_mean(rates.get(metric)) for metric in metrics)) for name, rates in found.items()]
    return ("arm", *(_SHORT[name] for name in metrics)), rows


def draws(results: Mapping[str, Any]) -> Cells:
    """How the weights of every arm lie."""
    names = ("effective", "effective_scenarios", "tilt", "largest", "concentration")
    heads = ("arm", "effective sample", "of scenarios", "tilt", "largest", "draws from 5 %")
    return heads, [(arm, *(f"{one[name]:.2f}" for name in names)) for arm, one in results["draws"].items()]


def rankings(results: Mapping[str, Any]) -> Cells:
    """How similar methods rank scenarios."""
    rows = [
        (
            f"{one['one']} and {one['other']}",
            f"{one['rho']:+.2f} [{one['interval'][0]:+.2f}, {one['interval'][1]:+.2f}]",
            f"{one['overlap']:.0%}",
            _SIGNS[one["orthogonal"]],
        )
        for one in results["rankings"]
    ]
    return ("methods", "rank correlation", "same among the top 5 %", "“they are orthogonal”"), rows


def mean_q(results: Mapping[str, Any]) -> Cells:
    """What choosing checkpoints by the highest mean Q costs."""
    rows = [
        (_SHORT[name], f"{one['difference']:+.3f} [{one['interval'][0]:+.3f}, {one['interval'][1]:+.3f}]")
        for name, one in results["mean_q"].items()
    ]
    return ("metric", "by mean Q minus by driving"), rows


def mean_q_curve(results: Mapping[str, Any]) -> Cells:
    """What the baseline's critics expected of it, and how it evaluated, at each validation."""
    mean_q, score = (np.array([one[name] for one in results["validations"]]) for name in ("mean_q", "score"))
    places = range(mean_q.shape[1])
    rows = [
        ("mean Q, over seeds", *(f"{one:.2f}" for one in mean_q.mean(axis=0))),
        ("score, over seeds", *(f"{one:.3f}" for one in score.mean(axis=0))),
        ("seeds whose highest mean Q it is", *(str((mean_q.argmax(axis=1) == k).sum()) for k in places)),
        ("seeds whose best score it is", *(str((score.argmax(axis=1) == k).sum()) for k in places)),
    ]
    return ("validation", *(str(k + 1) for k in places)), rows


def _conditions(results: Mapping[str, Any]) -> str:
    found = ", ".join(f"{_SHORT[name]} {value:.3f}" for name, value in results["detectable"].items())
    return _table(*conditions(results), "dense") + (
        "<p>The smallest difference in ordinary traffic that these seeds and scenarios find with a probability of "
        "80 %, at the strictest level of the first group of claims, if seeds vary as the baseline's: "
        f"{escape(found)}. A score that stands still is that of this budget and these learning rates. Baseline and bc "
        "had to be good enough before the others learned; the others are shown next to them.</p>"
    )


def _verdicts(results: Mapping[str, Any]) -> str:
    tables = {title: verdicts(results, group) for group, title in _GROUPS.items()}
    parts = [f"<h3>{title}</h3>" + _table(*cells, "wide") for title, cells in tables.items() if cells[1]]
    return "".join(parts) + (
        "<p><small>Differences are means over seeds and scenarios with 95 % intervals; both seeds and recordings are "
        "drawn by chance (Welch-Satterthwaite). P-values are adjusted for the number of claims in their group (Holm). "
        "A claim is supported or contradicted below 0.05, otherwise undecided; how many seeds or recordings would "
        "decide is reckoned as if the difference were the one found, at the strictest level of its group. A claim "
        "about a size is tested against that size. Compare the weights of a method and of its "
        "control in the table of weights. Scores are computed once: claims are about these scores, at this strength of "
        "weighting.</small></p>"
    )


def _verdict(one: Mapping[str, Any]) -> tuple[str, ...]:
    claim, low_high = one["claim"], one["interval"]
    difference = "" if low_high is None else (
        f"{one['difference']:+.3f} [{low_high[0]:+.3f}, {low_high[1]:+.3f}]"
    )  # fmt: skip
    change = "" if one["change"] is None else "{:+.0%} [{:+.0%}, {:+.0%}]".format(*one["change"])
    p = "" if one["adjusted"] is None else f"{one['adjusted']:.3f}".replace("0.000", "<0.001")
    verdict = _SIGNS[one["verdict"]]
    return claim["words"], _SHORT[claim["metric"]], difference, change, p, verdict, one["needed"]


def _rates(results: Mapping[str, Any], kind: str) -> str:
    cells, share = rates(results, kind), results["about"]["share"]
    if not cells[1]:
        return ""
    note = "" if kind != "ordinary" or share is None else (
        f"<p><small>Scenarios with an event count as in ordinary traffic, of which they are {share:.1%}.</small></p>"
    )  # fmt: skip
    return f"<h3>{_KINDS[kind]}</h3>" + _table(*cells, "dense") + note


def _mean(rate: Mapping[str, float] | None) -> str:
    return "" if rate is None else f"{rate['mean']:.3f} [{rate['low']:.3f}, {rate['high']:.3f}]"


def _rankings(results: Mapping[str, Any]) -> str:
    return _table(*rankings(results)) + (
        "<p><small>Of the scores of the training scenarios, with 95 % intervals over recordings. Rankings are called "
        f"unrelated where all of the interval is within ±{UNRELATED}, related where all of it is beyond ±{RELATED}. "
        "Two random rankings have 5 % of their top 5 % in common.</small></p>"
    )


def _mean_q(results: Mapping[str, Any]) -> str:
    seeds = results["validations"]
    same = sum(int(np.argmax(one["mean_q"]) == np.argmax(one["score"])) for one in seeds)
    return (
        _table(*mean_q(results))
        + "<p><small>The baseline's checkpoints with the highest mean Q on held-out steps, as the published study "
        "advises, against those with the best validation score, on the test set: the same runs, seed by seed. Both "
        f"rules take the same checkpoint of {same} of the {len(seeds)} seeds.</small></p>"
        + _table(*mean_q_curve(results), "dense")
    )


def _scores(tables: Mapping[str, ScoreTable]) -> str:
    charts = "".join(
        histogram(f"{name}: scores of scenarios", {name: table.scenarios}, "score")
        for name, table in tables.items()
    )
    tops = [
        (name, *(table.scenario_ids[row] for row in table.order[:3]))
        for name, table in tables.items()
        if name != "oracle"  # labels do not rank what they mark
    ]
    return (
        f"<div class=charts>{charts}</div>"
        + _table(("method", "most critical", "second", "third"), tops, "dense")
        + "<p>These drives can be watched in <a href=critical.html>critical.html</a>.</p>"
    )


def _action_map(actions: Actions) -> str:
    counts, _, _ = np.histogram2d(actions[:, 0], actions[:, 1], bins=_CELLS, range=((-1, 1), (-1, 1)))
    dark = np.log1p(counts) / np.log1p(counts.max())
    side = _SIZE / _CELLS
    cells = "".join(
        f'<rect x="{30 + column * side:.1f}" y="{(_CELLS - 1 - row) * side:.1f}" width="{side:.1f}" '
        f'height="{side:.1f}" fill="var(--ink)" fill-opacity="{dark[row, column]:.2f}"/>'
        for row, column in np.argwhere(counts > 0)
    )
    return (
        f'<figure class="chart map"><figcaption>How often experts do what<small>logarithmic; '
        f"{len(actions):,} steps</small></figcaption>"
        f'<svg viewBox="0 0 {_SIZE + 40} {_SIZE + 30}" role="img" aria-label="map of actions">{cells}'
        f'<text x="{30 + _SIZE / 2:.0f}" y="{_SIZE + 20}" text-anchor="middle">steering, left is positive</text>'
        f'<text transform="translate(18 {_SIZE / 2:.0f}) rotate(-90)" text-anchor="middle">acceleration</text>'
        "</svg></figure>"
    )
