"""All episodes of a report as a list in the page: worst first, sorted and filtered by metric, outcome and tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivax.evaluation.episode_table import RATES, EpisodeTable, ScenarioKey
from drivax.evaluation.pairing import comparable
from drivax.evaluation.tables import CODES, UNKNOWN, metric_label, metric_names, ordered
from drivax.report.episodes import outcome, worst_first
from drivax.report.pages.page import data_element
from drivax.report.table_files import Tags

#: Tags with more values than this (ids, places) are not offered as a choice.
MOST_VALUES = 24
#: Columns of the list, as far as a run has them; all other metrics filter and sort it.
_SHOWN = (
    "vmax_score", "at_fault_collision", "collision", "offroad", "red_light", "progress_ratio", "min_ttc", "comfortable",
)  # fmt: skip

EPISODE_LIST = """<form class=filters id=filters onsubmit="return false">
<label>planner <select name=run></select></label>
<label>outcome <select name=outcome></select></label>
<label>failed <select name=failed></select></label>
<label>metric <select name=metric></select></label>
<label class=bound><select name=sign aria-label="at least, at most or equal"><option value=ge>≥</option>
<option value=le>≤</option><option value=eq>=</option></select>
<input name=bound type=number step=any size=7 aria-label="bound of the metric" placeholder="number"></label>
<span id=tags></span>
<label>scenario <input name=words type=search placeholder="part of its id"></label>
<button type=button name=all>all</button></form>
<p id=count role=status></p>
<div class="scroll list" tabindex=0 role=region aria-label="list of episodes"><table class=episodes><thead><tr id=heads>
</tr></thead><tbody id=rows></tbody></table></div><button type=button id=more hidden>more</button>"""


def episode_data(runs: Sequence[EpisodeTable], tags: Tags, played: Mapping[ScenarioKey, int]) -> str:
    """Return the data of the list as a script element.

    ``metrics`` says how each is shown and which value of a rate is a failure; ``runs[].values`` holds one column per
    metric with four significant digits, null where undefined, rows worst first; ``runs[].errors`` by row the step and
    the error of a crash; ``tags`` holds for each tag its values and for each scenario the index of its value, which is
    ``unknown`` where it has none.

    Args:
        runs: Evaluations, the policy last.
        tags: The tags of scenarios.
        played: The scenarios in the player, and their place there.
    """
    names = ordered(metric_names(runs))
    names += [name for name in metric_names(runs) if name in CODES]
    keys = list(dict.fromkeys(key for run in runs for key in run.scenarios))
    place = {key: number for number, key in enumerate(keys)}
    return data_element(
        {
            "scenarios": [key[1] for key in keys],
            "tags": _tags([tags.get(key, {}) for key in keys]),
            "played": {str(place[key]): number for key, number in played.items()},
            "metrics": [_metric(name, runs) for name in names],
            "shown": [names.index(name) for name in _SHOWN if name in names],
            "runs": [_run(run, runs, names, place) for run in runs],
        },
        id="list",
    )


def _metric(name: str, runs: Sequence[EpisodeTable]) -> dict[str, Any]:
    label = metric_label(name, runs)
    bad = {"high": 0, "low": 1, "-": None}[label.better] if name in RATES else None
    return {"name": name, "label": label.text, "better": label.better, "unit": label.unit, "bad": bad}


def _run(
    run: EpisodeTable, runs: Sequence[EpisodeTable], names: Sequence[str], place: Mapping[ScenarioKey, int]
) -> dict[str, Any]:
    rows = worst_first(run, [other for other in runs if other is not run])
    outcomes = [outcome(run, row) for row in rows]
    distinct = list(dict.fromkeys(outcomes))
    keys = run.scenarios
    scenarios, crashes = [keys[row] for row in rows], run.crash_by_scenario
    return {
        "name": run.name,
        "playable": comparable(run, runs[-1]),
        "scenario": [place[key] for key in scenarios],
        "outcomes": distinct,
        "outcome": [distinct.index(words) for words in outcomes],
        "errors": {
            str(row): (crashes[key].step, crashes[key].error)
            for row, key in enumerate(scenarios)
            if key in crashes
        },
        "values": [_column(run.metrics.get(name), rows) for name in names],
    }


def _column(values: Any, rows: Sequence[int]) -> list[float | None]:
    if values is None:
        return [None] * len(rows)
    return [None if np.isnan(value) else _rounded(value) for value in np.asarray(values)[rows]]


def _rounded(value: float) -> float:
    """Return four significant digits; whole numbers as such, which are shorter."""
    rounded = float(f"{value:.4g}")
    return int(rounded) if rounded.is_integer() else rounded


def _tags(tagged: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    columns = []
    for name in dict.fromkeys(name for tags in tagged for name in tags):
        values = [tags.get(name, UNKNOWN) for tags in tagged]
        distinct = sorted(set(values))
        if 1 < len(distinct) <= MOST_VALUES:
            number = {value: place for place, value in enumerate(distinct)}
            columns.append({"name": name, "words": distinct, "of": [number[value] for value in values]})
    return columns
