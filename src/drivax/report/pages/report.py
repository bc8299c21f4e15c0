"""Report of run folders: one self-contained HTML page, and its tables as files.

The page has tables with intervals, all episodes, rollouts and learning curves. Tables of evaluations become CSV (with
all digits), Markdown and LaTeX files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import UsageError, did_you_mean
from drivax.evaluation import result_tables
from drivax.evaluation.episode_table import ADDED, NOT_SUMMARISED, RATES, EpisodeTable, ScenarioKey, Tags
from drivax.evaluation.pairing import comparable, mismatch
from drivax.files import check_output, inside, write_text
from drivax.metrics.catalogue import METRICS, SETS
from drivax.report.charts import curve_sections, distribution_charts
from drivax.report.episodes import EpisodeGroup, EvaluatedSet, choose, outcome, rollouts_of, sort_worst_first
from drivax.report.pages.page import (
    asset,
    data_element,
    definitions,
    facts_html,
    page,
    player_data,
    player_html,
    player_scripts,
    section,
)
from drivax.report.pictures.player_data import pack_episode
from drivax.report.runs import TrainingCurves, read_evaluations, read_runs
from drivax.table import Table, bounds, number, suffix

EPISODES = 12
#: Selected episodes, and their data for the player.
PackedEpisodes = Sequence[tuple[EpisodeGroup, Mapping[str, Any]]]
#: Columns of the tables by tag, few enough for a page.
KEY_METRICS = (
    "success", "accuracy", "collision", "at_fault_collision", "offroad", "red_light", "progress_ratio", "vmax_score",
)  # fmt: skip
#: Metrics of a transfer matrix.
TRANSFER_METRICS = ("success", "vmax_score")


def write_report(
    runs: Sequence[Path], out: Path, data: Path | None = None, episodes: int = EPISODES, overwrite: bool = False
) -> Path:  # fmt: skip
    """Write a report of evaluation and training runs to the HTML file ``out``; the last evaluation is the policy.

    Args:
        runs: Run folders of ``drivax evaluate`` and ``drivax train``, in the order of the tables.
        out: The file.
        data: Path of the policy's scenario set, if it has moved.
        episodes: Number of playable episodes. A page with 0 has no rollouts or tags, and needs no scenario set.
        overwrite: Replace an existing file.

    Raises:
        DataError: A run folder or the scenario set is missing or damaged, or the set is not the evaluated one.
        UsageError: ``out`` exists without ``overwrite`` or is a folder, no run is given or one twice, or ``episodes``
            is negative.
    """
    check_output(out, overwrite)
    if episodes < 0:
        raise UsageError(f"cannot show {episodes} episodes", cure="give 0 or more")
    evaluations, trainings = read_runs(runs)
    packed_episodes, tags = (
        _load_episodes(evaluations, data, episodes) if evaluations and episodes else ((), {})
    )
    write_text(out, _page(evaluations, trainings, packed_episodes, tags))
    return out


def _load_episodes(
    runs: Sequence[EpisodeTable], data: Path | None, count: int
) -> tuple[PackedEpisodes, Tags]:
    """Return the selected episodes with their data for the player, and the tags of all scenarios."""
    scenarios = EvaluatedSet(runs[-1], data)
    packed_episodes = []
    for group in choose(runs, count):
        scenario = scenarios.scenario(group.key)
        title = f"{group.scenario_id}: {group.outcome}"
        packed_episodes.append((group, pack_episode(scenario, rollouts_of(runs, group, scenario), title)))
    return packed_episodes, scenarios.tags()


def _page(
    runs: Sequence[EpisodeTable],
    trainings: Sequence[TrainingCurves],
    packed_episodes: PackedEpisodes,
    tags: Tags,
) -> str:
    sections, data, scripts = [], [], []
    if runs:
        sections = [
            _results(runs), _differences(runs), _transfer(runs), _collisions(runs),
            _strata(runs, tags), _distributions(runs), _episodes(runs, packed_episodes),
        ]  # fmt: skip
        playable: dict[ScenarioKey, int] = {
            group.key: index for index, (group, _) in enumerate(packed_episodes)
        }
        data = player_data([episode for _, episode in packed_episodes]) if packed_episodes else []
        data.append(episode_data(runs, tags, playable))
        scripts += [*(player_scripts() if packed_episodes else ()), asset("episode_table.js")]
    if trainings:
        sections.append(section("Learning curves", _unhealthy_critics(trainings), curve_sections(trainings)))
    if runs:
        meanings = explanations(result_tables.sort_metrics(result_tables.metric_names(runs)), runs)
        sections.append(section("What the metrics mean", meanings))
    sections.append(_provenance([*runs, *trainings]))
    title = f"{runs[-1].name}: evaluation report" if runs else "training report"
    return page(title, _lead(runs), sections, data=data, scripts=scripts)


def _unhealthy_critics(trainings: Sequence[TrainingCurves]) -> str:
    """Return a list of what is wrong with critics; empty if nothing is."""
    items = [
        f"<li>{escape(training.name)}: {escape(str(problem))}</li>"
        for training in trainings
        for problem in training.info.get("critics") or ()
    ]
    return f"<p><b>Unhealthy critics:</b></p><ul>{''.join(items)}</ul>" if items else ""


def _lead(runs: Sequence[EpisodeTable]) -> str:
    if not runs:
        return "<p class=lead>Training runs only; evaluate a policy to see how it drives.</p>"
    policy = runs[-1]
    path = Path(str(policy.data.get("path", "its scenario set")))
    name, data_name = escape(policy.name), escape(str(policy.data.get("name") or path.name))
    verbs = {"success": "succeeds in", "accuracy": "has no collision, off-road step or red light in"}
    for metric, verb in verbs.items():
        interval = result_tables.summarise(policy, metric)
        if interval.mean is not None:
            share = number(interval.mean, "rate") + suffix("rate")
            return (
                f"<p class=lead><b>{name}</b> {verb} <b>{share}</b> ({bounds(interval, 'rate')}) of {interval.n} "
                f"{'episode' if interval.n == 1 else 'episodes'} of {data_name}, {escape(policy.traffic)} traffic.</p>"
            )
    return f"<p class=lead><b>{name}</b>: {len(policy)} episodes of {data_name}.</p>"


def _results(runs: Sequence[EpisodeTable]) -> str:
    names = result_tables.metric_names(runs)
    headline = _first_metrics(runs, names)
    others = [name for name in result_tables.sort_metrics(names) if name not in headline]
    table = result_tables.planners_table(runs, headline).html() if headline else ""
    details = (
        f"<summary>{len(others)} more metrics</summary>{result_tables.planners_table(runs, others).html()}"
    )
    note = (
        f"Mean, {result_tables.CONFIDENCE:.0%} interval, and n, the number of episodes where the metric is defined. "
        "The best mean is underlined, whether or not its lead is significant. Click a mean for its episodes. "
        "Intervals: Wilson's for rates (with the effective number of episodes if some share a recording), a bootstrap "
        "over recordings otherwise."
    )
    details = f"<details>{details}</details>" if others else ""
    return section("Results", _comparability_warning(runs), table, details, note=note)


def _first_metrics(runs: Sequence[EpisodeTable], names: Sequence[str]) -> list[str]:
    """Return the metrics of the first table: crashes, if there were any, and the headline metrics."""
    any_crash = any((run.metrics.get("crashed", np.zeros(1)) > 0).any() for run in runs)
    return [*(["crashed"] if any_crash and "crashed" in names else []), *result_tables.headline_names(names)]


def _comparability_warning(runs: Sequence[EpisodeTable]) -> str:
    """Return a warning about runs that are not comparable with the policy; empty if all are."""
    policy = runs[-1]
    reasons = []
    for run in runs[:-1]:
        scenarios, policy_scenarios = set(run.scenarios), set(policy.scenarios)
        if reason := mismatch(run, policy):
            reasons.append(f"{run.name} and {policy.name} {reason[0]}")
        elif scenarios != policy_scenarios:
            counts = f"{len(scenarios & policy_scenarios)} of {len(scenarios)} and {len(policy_scenarios)}"
            reasons.append(f"{run.name} and {policy.name} have {counts} scenarios in common")
    text = "; ".join(map(escape, reasons))
    return f"<p><b>Not all rows are comparable:</b> {text}.</p>" if text else ""


def _differences(runs: Sequence[EpisodeTable]) -> str:
    policy, others = runs[-1], runs[:-1]
    names = _first_metrics(runs, list(policy.metrics)) or result_tables.sort_metrics(list(policy.metrics))
    if not others or not names:
        return ""
    note = (
        "Mean of the differences by scenario, over the scenarios where both are defined (n pairs), with a "
        f"{result_tables.CONFIDENCE:.0%} bootstrap interval over recordings. “Better” and “worse”: the interval "
        "excludes zero; it is not widened for the number of comparisons. “All equal”: the mean difference is "
        "the same in all recordings, which leaves the bootstrap without width."
    )
    table = result_tables.differences_table(policy, others, names).html()
    return section(f"{escape(policy.name)} against the others", table, note=note)


def _transfer(runs: Sequence[EpisodeTable]) -> str:
    """Return the results by training and evaluation data, or "" if all runs share one set."""
    tables_html = "".join(
        f"<h3>{escape(result_tables.metric_label(table.name.removeprefix('transfer-'), runs).text)}</h3>{table.html()}"
        for table in transfer_tables(runs)
    )
    note = (
        "Rows: planners and their training data (– for no training, or unknown data). Columns: "
        "evaluation data. Sets differ in difficulty: compare along a column."
    )
    return section("Transfer", tables_html, note=note)


def _collisions(runs: Sequence[EpisodeTable]) -> str:
    """Return the kinds of the first collision with their meanings, or "" without a collision of a known kind."""
    table = result_tables.collisions_table(runs)
    if not any(cell.interval and cell.interval.mean for row in table.rows for cell in row):
        return ""
    kinds = result_tables.COLLISION_KINDS.values()
    meanings = definitions((name, f"{meaning[:1].upper()}{meaning[1:]}.") for name, meaning in kinds)
    types = [(run, run.metrics["collision_type"]) for run in runs if "collision_type" in run.metrics]
    counts = ", ".join(f"{escape(run.name)} {int((kind > 0).sum())} of {len(run)}" for run, kind in types)
    parts = f"<p>Episodes with a collision of known kind: {counts}.</p>", table.html(), meanings
    return section("Kinds of collision", *parts, note=f"{escape(table.caption)} (Wilson's).")


def _strata(runs: Sequence[EpisodeTable], tags: Tags) -> str:
    """Return the results by kind of scenario, or "" without tags."""
    tables_html = "".join(
        f"<details{'' if index else ' open'}><summary>{escape(table.name.replace('-', ' '))}</summary>"
        f"{table.html()}</details>"
        for index, table in enumerate(strata_tables(runs, tags))
    )
    note = "Tags describe the log. Small strata have wide intervals; of many cells, some stand out by chance."
    return section("By kind of scenario", tables_html, note=note)


def _distributions(runs: Sequence[EpisodeTable]) -> str:
    note = "The height of a line at a value is the share of episodes at or below it, where the metric is defined."
    return section("Distributions", distribution_charts(runs), note=note)


def _episodes(runs: Sequence[EpisodeTable], packed_episodes: PackedEpisodes) -> str:
    note = (
        "▶ marks the episodes in the player below."
        if packed_episodes
        else "This page has no rollouts and no tags."
    )
    text = (
        "<p>All episodes, worst first: by the severity of failures, then by the lowest score. Click a number in the "
        f"tables above for its episodes. {note}</p>"
    )
    episode_list = asset("episode_list.html").rstrip()
    return section("Episodes", text, episode_list, _player(runs, packed_episodes), attributes=" id=episodes")


def _player(runs: Sequence[EpisodeTable], packed_episodes: PackedEpisodes) -> str:
    if not packed_episodes:
        return ""
    buttons = "".join(
        f"<button type=button data-episode aria-pressed=false>"
        f'<span class="{"good" if group.outcome == "success" else "bad"}">{escape(group.outcome)}</span>'
        f"<small>{escape(group.scenario_id)}</small></button>"
        for group, _ in packed_episodes
    )
    policy = escape(runs[-1].name)
    comparable_runs = [run for run in runs if comparable(run, runs[-1])]
    caution = ""
    if len(comparable_runs) > 1 and runs[-1].traffic != "log":
        caution = (
            f"<p><b>Other agents are drawn as they moved around {policy};</b> around the others they reacted "
            "differently.</p>"
        )
    return (
        f"<h3>Rollouts</h3><p>Selected by rule: failures of {policy} first, each kind in turn, then successes. All "
        "planners start at the same time, and from the same state unless noisy starts have different seeds.</p>"
        f"{caution}"
        f"<div class=picker role=group aria-label=Rollouts>{buttons}</div><h3 data-control=title></h3>{player_html()}"
    )


def explanations(metrics: Sequence[str], runs: Sequence[EpisodeTable]) -> str:
    """Return a list that explains each known metric in one line."""
    labels = [label for metric in metrics if (label := result_tables.metric_label(metric, runs)).explanation]
    return definitions((label.heading, label.explanation) for label in labels)


def _provenance(runs: Sequence[EpisodeTable | TrainingCurves]) -> str:
    """Return the provenance of the numbers: commands, data, versions and every ``run.json``."""
    rows = []
    for run in runs:
        data = run.data if isinstance(run, EpisodeTable) else next(iter(run.info.get("data") or ()), {})
        command, versions = run.info.get("command"), run.info.get("versions")
        texts = (
            " ".join(map(str, command)) if isinstance(command, list) else str(command or ""),
            f"{data.get('path', '')} {str(data.get('hash') or '')[:12]}".strip(),
            ", ".join(f"{k} {v}" for k, v in versions.items()) if isinstance(versions, dict) else "",
        )
        rows.append((run.name, [text or "–" for text in texts]))
    settings = "".join(
        f"<h3>{escape(run.name)}</h3><pre>{escape(json.dumps(dict(run.info), indent=1, ensure_ascii=False))}</pre>"
        for run in runs
    )
    return section(
        "How this was made",
        facts_html(["run", "command", "data", "versions"], rows),
        f"<details><summary>all settings</summary>{settings}</details>",
        note=f"drivax {escape(metadata.version('drivax'))}. The numbers of an evaluation come from its episodes.csv, "
        "those of rollouts from trajectories.npz, learning curves from metrics.jsonl.",
    )


#: Tags with more values, such as ids and places, cannot be selected.
MAX_TAG_VALUES = 24
#: Columns of the list, if a run has them; all other metrics filter and sort it.
_SHOWN = (
    "vmax_score", "at_fault_collision", "collision", "offroad", "red_light", "progress_ratio", "min_ttc", "comfortable",
)  # fmt: skip


def episode_data(runs: Sequence[EpisodeTable], tags: Tags, playable: Mapping[ScenarioKey, int]) -> str:
    """Return the data of the list as a script element; ``playable`` has the player's index of each shown episode.

    - ``scenarios``: ids; ``played`` has the player's index by index of the scenario.
    - ``metrics``: label of each metric, and the value of a rate that means failure; ``shown`` has the indices of those
      that are columns of the list.
    - ``runs[].values``: a column per metric, worst row first, with four significant digits; null where undefined.
    - ``runs[].errors``: step and error of each crash by row.
    - ``tags``: words of each tag, and their indices for each scenario.
    """
    names = result_tables.sort_metrics(result_tables.metric_names(runs))
    names += [name for name in result_tables.metric_names(runs) if name in NOT_SUMMARISED]
    keys = list(dict.fromkeys(key for run in runs for key in run.scenarios))
    index_of = {key: number for number, key in enumerate(keys)}
    return data_element(
        {
            "scenarios": [key[1] for key in keys],
            "tags": _tags([tags.get(key, {}) for key in keys]),
            "played": {str(index_of[key]): number for key, number in playable.items()},
            "metrics": [_metric(name, runs) for name in names],
            "shown": [names.index(name) for name in _SHOWN if name in names],
            "runs": [_run(run, runs, names, index_of) for run in runs],
        },
        id="list",
    )


def _metric(name: str, runs: Sequence[EpisodeTable]) -> dict[str, Any]:
    """Return the label of a metric; ``bad`` is the value of a rate that means failure, None for other metrics."""
    label = result_tables.metric_label(name, runs)
    bad = {"high": 0, "low": 1, "-": None}[label.better] if name in RATES else None
    return {"name": name, "label": label.text, "better": label.better, "unit": label.unit, "bad": bad}


def _run(
    run: EpisodeTable, runs: Sequence[EpisodeTable], names: Sequence[str], index_of: Mapping[ScenarioKey, int]
) -> dict[str, Any]:
    """Return a run's episodes, worst first."""
    rows = sort_worst_first(run, [other for other in runs if other is not run])
    outcomes = [outcome(run, row) for row in rows]
    outcome_names = list(dict.fromkeys(outcomes))
    keys = run.scenarios
    scenarios, crashes = [keys[row] for row in rows], run.crash_by_scenario
    crash_rows = [(row, crashes[key]) for row, key in enumerate(scenarios) if key in crashes]
    return {
        "name": run.name,
        "playable": comparable(run, runs[-1]),
        "scenario": [index_of[key] for key in scenarios],
        "outcomes": outcome_names,
        "outcome": [outcome_names.index(name) for name in outcomes],
        "errors": {str(row): (crash.step, crash.error) for row, crash in crash_rows},
        "values": [_column(run.metrics.get(name), rows) for name in names],
    }


def _column(values: Any, rows: Sequence[int]) -> list[float | None]:
    """Return a metric in these rows, None where it is undefined or the run lacks it."""
    if values is None:
        return [None] * len(rows)
    return [None if np.isnan(value) else _round_significant(value) for value in np.asarray(values)[rows]]


def _round_significant(value: float) -> float:
    """Round to four significant digits; integers become ``int``, which is shorter in JSON."""
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded


def _tags(scenario_tags: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Return each selectable tag: its words, and the indices of each scenario's words."""
    columns = []
    for name in dict.fromkeys(name for tags in scenario_tags for name in tags):
        values = [tags.get(name, result_tables.UNKNOWN).split("|") for tags in scenario_tags]
        vocabulary = sorted({word for words in values for word in words})
        if 1 < len(vocabulary) <= MAX_TAG_VALUES:
            index_of = {word: index for index, word in enumerate(vocabulary)}
            indices = [[index_of[word] for word in words] for words in values]
            columns.append({"name": name, "words": vocabulary, "of": indices})
    return columns


def write_tables(
    runs: Sequence[Path], out: Path, data: Path | None = None, overwrite: bool = False, metrics: Sequence[str] = ()
) -> list[Path]:  # fmt: skip
    """Write every table of a report into a folder as ``.csv``, ``.md`` and ``.tex``, and return the files.

    The tables are ``results``, ``differences`` (several runs; columns for those that are comparable with the policy),
    ``collisions`` (known kinds of collision), ``by-TAG`` (:func:`strata_tables`) and ``transfer-METRIC`` (runs on
    several data sets).

    Args:
        runs: Run folders; the last evaluation is the policy.
        out: Folder of the tables.
        data: Path of the policy's scenario set, if it has moved.
        overwrite: Replace existing files.
        metrics: Extra columns of ``episodes.csv``, or sets of metrics, for ``results``, ``differences`` and ``by-TAG``.

    Raises:
        DataError: A run folder or the scenario set is missing or damaged, the set is not the evaluated one, or a file
            in ``out`` is a symbolic link.
        UsageError: A file exists without ``overwrite``, no run is an evaluation, or no run has one of the metrics.
    """
    texts = {}
    for table in _tables(read_evaluations(runs), data, metrics):
        formats = {"csv": table.csv(), "md": table.markdown(), "tex": table.latex()}
        texts |= {f"{table.name}.{ending}": text for ending, text in formats.items()}
    files = {inside(out, name): text for name, text in texts.items()}
    for file in files:
        check_output(file, overwrite)
    for file, text in files.items():
        write_text(file, text)
    return list(files)


def select_metrics(runs: Sequence[EpisodeTable], extra: Sequence[str] = ()) -> list[str]:
    """Return the metrics of the files: headline metrics, progress in metres, user-defined metrics, and ``extra``.

    ``extra`` has names of metrics and of sets of metrics. Runs without any of these metrics have all of theirs.

    Raises:
        UsageError: ``extra`` names no set, and no metric of which a run has a mean.
    """
    names = result_tables.sort_metrics(result_tables.metric_names(runs))
    selected = {"progress"}
    for entry in extra:
        if entry not in SETS and entry not in names:
            raise UsageError(f"no run has a mean of {entry!r}", cure=did_you_mean(entry, [*SETS, *names]))
        selected.update(SETS.get(entry, (entry,)))
    headline = result_tables.headline_names(names)
    others = [name for name in names if name in selected or name not in (*METRICS, *ADDED)]
    return [*headline, *(name for name in others if name not in headline)] or names


def _tables(runs: Sequence[EpisodeTable], data: Path | None, extra: Sequence[str]) -> list[Table]:
    """Return all tables in the order of the files."""
    default_metrics, metrics = select_metrics(runs), select_metrics(runs, extra)
    results = [result_tables.results_table(runs, metrics)]
    if len(runs) > 1:
        others = [run for run in runs[:-1] if comparable(runs[-1], run)]
        results.append(result_tables.differences_table(runs[-1], others, metrics))
    if any("collision_type" in run.metrics for run in runs):
        results.append(result_tables.collisions_table(runs))
    extra_metrics = [name for name in metrics if name not in default_metrics]
    results += strata_tables(runs, EvaluatedSet(runs[-1], data).tags(), extra_metrics)
    return results + transfer_tables(runs)


def strata_tables(runs: Sequence[EpisodeTable], tags: Tags, extra: Sequence[str] = ()) -> list[Table]:
    """Return a table for each tag of ``result_tables.STRATA`` that the scenarios have, of the runs on these scenarios.

    Columns are :data:`KEY_METRICS` and ``extra``.
    """
    runs = [run for run in runs if any(key in tags for key in run.scenarios)]
    tag_names = {name for scenario_tags in tags.values() for name in scenario_tags}
    names = dict.fromkeys((*KEY_METRICS, *extra))
    metrics = [name for name in names if any(name in run.metrics for run in runs)]
    strata = [tag for tag in result_tables.STRATA if tag in tag_names]
    return [result_tables.strata_table(runs, tags, tag, metrics) for tag in strata]


def transfer_tables(runs: Sequence[EpisodeTable]) -> list[Table]:
    """Return a matrix of training and evaluation data for each defined metric of :data:`TRANSFER_METRICS`.

    There is no table if all runs share one set.
    """
    if len({result_tables.set_key(run.data) for run in runs}) < 2:
        return []
    metrics = [name for name in TRANSFER_METRICS if any(result_tables.summarise(run, name).n for run in runs)]
    return [result_tables.transfer_table(runs, name) for name in metrics]
