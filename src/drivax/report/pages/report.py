"""One self-contained HTML page from run folders: tables with intervals, all episodes, drives side by side, curves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.evaluation.episode_table import ScenarioKey
from drivax.evaluation.pairing import comparable, mismatch
from drivax.evaluation.tables import CONFIDENCE, summarise
from drivax.report.breakdowns import Tags, collision_section, strata_section, transfer_section
from drivax.report.charts.curves import curve_sections
from drivax.report.charts.distributions import distribution_charts
from drivax.report.comparison import metric_names
from drivax.report.episode_selection import Choice, choose
from drivax.report.episodes import DrivenSet, drives_of
from drivax.report.glossary import headline, ordered
from drivax.report.html_tables import bounds, difference_table, explanations, number, percent, planner_table
from drivax.report.loaded_runs import Evaluation, Training, read_runs
from drivax.report.pages.episode_list import EPISODE_LIST, episode_data
from drivax.report.pages.page import asset, page, publish, refuse_page
from drivax.report.pages.player import player_data, player_html, player_scripts
from drivax.report.pictures.episode import pack_episode

EPISODES = 12
#: A chosen episode and its data for the player.
Packed = Sequence[tuple[Choice, Mapping[str, Any]]]


def write_report(
    runs: Sequence[Path],
    out: Path,
    data: Path | None = None,
    episodes: int = EPISODES,
    overwrite: bool = False,
) -> Path:
    """Write a report of evaluation and training runs; the last evaluation is the policy in question.

    Args:
        runs: Run folders of ``drivax evaluate`` and ``drivax train``, in the order of the tables.
        out: The HTML file to write; it appears when it is complete.
        data: The scenario set that was driven, where it is not at the place that the policy's run names.
        episodes: How many drives to show; 0 leaves out drives and tags and needs no scenario set.
        overwrite: Replace an existing file.

    Returns:
        ``out``.

    Raises:
        DataError: A run folder or the scenario set is missing, damaged, or not the one that was driven.
        UsageError: ``out`` exists, or the arguments make no sense.
    """
    refuse_page(out, overwrite)
    if episodes < 0:
        raise UsageError(f"cannot show {episodes} episodes", cure="give 0 or more")
    evaluations, trainings = read_runs(runs)
    packed: Packed = ()
    tags: Tags = {}
    if evaluations and episodes:
        packed, tags = _from_the_set(evaluations, data, episodes)
    publish(out, _page(evaluations, trainings, packed, tags))
    return out


def _from_the_set(runs: Sequence[Evaluation], data: Path | None, count: int) -> tuple[Packed, Tags]:
    """The chosen episodes with their data for the player, and the tags of all scenarios of the policy's set."""
    driven = DrivenSet(runs[-1], data)
    packed = []
    for choice in choose(runs, count):
        scenario = driven.scenario((choice.dataset, choice.scenario_id))
        title = f"{choice.scenario_id}: {choice.outcome}"
        packed.append((choice, pack_episode(scenario, drives_of(runs, choice, scenario), title)))
    return packed, driven.tags()


def _page(runs: Sequence[Evaluation], trainings: Sequence[Training], packed: Packed, tags: Tags) -> str:
    sections, data, scripts = [], [], []
    if runs:
        sections += [_results(runs), _differences(runs), transfer_section(runs), collision_section(runs)]
        sections += [strata_section(runs, tags), _distributions(runs), _episodes(runs, packed)]
        played: dict[ScenarioKey, int] = {
            (choice.dataset, choice.scenario_id): place for place, (choice, _) in enumerate(packed)
        }
        data += player_data([episode for _, episode in packed]) if packed else []
        data.append(episode_data(runs, tags, played))
        scripts += [*(player_scripts() if packed else ()), asset("episode_table.js")]
    if trainings:
        sections.append(f"<section><h2>Learning curves</h2>{curve_sections(trainings)}</section>")
    if runs:
        sections.append(_meaning(runs))
    sections.append(_origin([*runs, *trainings]))
    title = f"{runs[-1].name}: evaluation report" if runs else "training report"
    return page(title, _lead(runs), sections, data=data, scripts=scripts)


def _lead(runs: Sequence[Evaluation]) -> str:
    if not runs:
        return "<p class=lead>Training runs only; evaluate one to see how it drives.</p>"
    policy = runs[-1]
    path = Path(str(policy.data.get("path", "its scenario set")))
    where = escape(str(policy.data.get("name") or path.name))
    words = {"success": "succeeds in", "accuracy": "drives without failure in"}
    found = {name: summarise(policy, name) for name in words}
    name = next((name for name in words if found[name].mean is not None), None)
    if name is None:
        return f"<p class=lead><b>{escape(policy.name)}</b> drove {len(policy)} episodes of {where}.</p>"
    interval = found[name]
    share = number(interval.mean, "rate") + percent("rate")
    return (
        f"<p class=lead><b>{escape(policy.name)}</b> {words[name]} <b>{share}</b> ({bounds(interval, 'rate')}) of "
        f"{interval.n} {'episode' if interval.n == 1 else 'episodes'} of {where}, {escape(policy.traffic)} traffic.</p>"
    )


def _results(runs: Sequence[Evaluation]) -> str:
    names = metric_names(runs)
    first = _first(runs, names)
    rest = [name for name in ordered(names) if name not in first]
    more = (
        f"<details><summary>{len(rest)} more metrics</summary>{planner_table(runs, rest)}</details>"
        if rest
        else ""
    )
    return (
        f"<section><h2>Results</h2>{_warning(runs)}{planner_table(runs, first) if first else ''}{more}<p><small>"
        f"Mean, {CONFIDENCE:.0%} interval, and n, the number of episodes where the metric is defined; undefined "
        "episodes are left out. The best mean is underlined, whether or not it is clearly best. A mean "
        "leads to the episodes behind it. Intervals: Wilson's for rates (with the effective number of episodes "
        "where some share a recording), a bootstrap over recordings otherwise.</small></p></section>"
    )


def _first(runs: Sequence[Evaluation], names: Sequence[str]) -> list[str]:
    """The headline; with the crashes, where there were any."""
    crashed = any((run.metrics.get("crashed", np.zeros(1)) > 0).any() for run in runs)
    return [*(["crashed"] if crashed and "crashed" in names else []), *headline(names)]


def _warning(runs: Sequence[Evaluation]) -> str:
    """Which rows cannot be compared with the policy's, and why; empty where all can."""
    policy = runs[-1]
    reasons = []
    for run in runs[:-1]:
        driven, of = set(run.scenarios), set(policy.scenarios)
        if found := mismatch(run, policy):
            reasons.append(f"{run.name} and {policy.name} {found[0]}")
        elif driven != of:
            counts = f"{len(driven & of)} of {len(driven)} and {len(of)}"
            reasons.append(f"{run.name} and {policy.name} have {counts} scenarios in common")
    told = "; ".join(map(escape, reasons))
    return f"<p><b>Not all rows are comparable:</b> {told}.</p>" if told else ""


def _differences(runs: Sequence[Evaluation]) -> str:
    policy, others = runs[-1], runs[:-1]
    names = _first(runs, list(policy.metrics)) or ordered(list(policy.metrics))
    if not others or not names:
        return ""
    return (
        f"<section><h2>{escape(policy.name)} against the others</h2>{difference_table(policy, others, names)}<p><small>"
        "Mean of the differences, scenario by scenario, over those where both are defined (n pairs), with a "
        f"{CONFIDENCE:.0%} bootstrap interval over recordings. “Better” and “worse” are said where the interval leaves "
        "out zero; it is not widened for the number of comparisons. “All alike”: no "
        "pair differs from the next, so that a bootstrap cannot tell how sure the mean is.</small></p></section>"
    )


def _distributions(runs: Sequence[Evaluation]) -> str:
    charts = distribution_charts(runs)
    return (
        f"<section><h2>Distributions</h2>{charts}<p><small>The height of a line at a value is the share of episodes "
        "that lie at or below it; undefined ones are left out.</small></p></section>"
        if charts
        else ""
    )


def _episodes(runs: Sequence[Evaluation], packed: Packed) -> str:
    told = "▶ marks those that play below." if packed else "Drives and tags were left out of this page."
    return (
        f"<section id=episodes><h2>Episodes</h2><p>All episodes, worst first: the gravest kind of failure, then the "
        f"lowest score. A number in the tables above leads to the episodes behind it. {told}</p>{EPISODE_LIST}"
        f"{_player(runs, packed)}</section>"
    )


def _player(runs: Sequence[Evaluation], packed: Packed) -> str:
    if not packed:
        return ""
    buttons = "".join(
        f"<button type=button data-episode aria-pressed=false>"
        f'<span class="{"good" if choice.outcome == "success" else "bad"}">{escape(choice.outcome)}</span>'
        f"<small>{escape(choice.scenario_id)}</small></button>"
        for choice, _ in packed
    )
    shown = [run for run in runs if comparable(run, runs[-1])]
    caution = (
        f"<p><b>Other agents are drawn as they moved around {escape(runs[-1].name)};</b> around the others they "
        "reacted otherwise.</p>"
        if len(shown) > 1 and runs[-1].traffic != "log"
        else ""
    )
    return (
        f"<h3>Drives</h3><p>Chosen by rule: failures of {escape(runs[-1].name)} first, each kind in turn, then "
        f"successes. All planners that are shown start from the same scene at the same time.</p>{caution}"
        f"<div class=picker role=group aria-label=Drives>{buttons}</div><h3 data-control=title></h3>{player_html()}"
    )


def _meaning(runs: Sequence[Evaluation]) -> str:
    return (
        f"<section><h2>What the metrics mean</h2>{explanations(ordered(metric_names(runs)), runs)}</section>"
    )


def _origin(runs: Sequence[Evaluation | Training]) -> str:
    """Where the numbers come from: commands, data, versions and the whole of every ``run.json``."""
    rows = []
    for run in runs:
        about = run.info
        data = run.data if isinstance(run, Evaluation) else {}
        versions = about.get("versions")
        facts = {
            "command": _words(about.get("command")),
            "data": f"{data.get('path', '')} {str(data.get('hash') or '')[:12]}".strip(),
            "versions": ", ".join(f"{k} {v}" for k, v in versions.items())
            if isinstance(versions, dict)
            else "",
        }
        cells = "".join(f"<td>{escape(text) or '–'}</td>" for text in facts.values())
        rows.append(f"<tr><th scope=row>{escape(run.name)}</th>{cells}</tr>")
    whole = "".join(
        f"<h3>{escape(run.name)}</h3><pre>{escape(json.dumps(dict(run.info), indent=1, ensure_ascii=False))}</pre>"
        for run in runs
    )
    head = "<thead><tr><th>run</th><th>command</th><th>data</th><th>versions</th></tr></thead>"
    return (
        f"<section><h2>How this was made</h2><div class=scroll tabindex=0><table class=facts>{head}"
        f"<tbody>{''.join(rows)}</tbody></table></div><details><summary>all settings</summary>{whole}</details>"
        f"<p><small>drivax {escape(metadata.version('drivax'))}. Every number comes from the episodes.csv of its run."
        "</small></p></section>"
    )


def _words(command: Any) -> str:
    return " ".join(map(str, command)) if isinstance(command, list) else str(command or "")
