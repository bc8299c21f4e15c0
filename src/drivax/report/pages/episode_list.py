"""All episodes of a report as a list in the page: worst first, to be sorted and sieved by metric, outcome and tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivax.evaluation.episode_table import RATES, ScenarioKey
from drivax.evaluation.pairing import comparable
from drivax.evaluation.tables import UNKNOWN
from drivax.report.breakdowns import Tags
from drivax.report.comparison import metric_names
from drivax.report.episode_selection import outcome, worst_first
from drivax.report.glossary import CODES, note, ordered
from drivax.report.loaded_runs import Evaluation
from drivax.report.pages.page import data_element

#: Tags with more values than this (ids, places) are not offered as a choice.
MOST_VALUES = 24
#: Columns of the list, as far as a run has them; by everything else it can be sieved and sorted.
_SHOWN = (
    "vmax_score", "at_fault_collision", "collision", "offroad", "red_light", "progress_ratio", "min_ttc", "comfortable",
)  # fmt: skip

EPISODE_LIST = """<form class=sieve id=sieve onsubmit="return false">
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
<p id=found role=status></p>
<div class="scroll list" tabindex=0 role=region aria-label="list of episodes"><table class=episodes><thead><tr id=heads>
</tr></thead><tbody id=rows></tbody></table></div><button type=button id=more hidden>more</button>"""


def episode_data(runs: Sequence[Evaluation], tags: Tags, played: Mapping[ScenarioKey, int]) -> str:
    """The data of the list as a script element.

    ``metrics`` says how each is shown and which value of a rate is a failure; ``runs[].values`` holds one column per
    metric with four significant digits, null where undefined, rows worst first, ``runs[].errors`` by row the step and
    the words of a crash; ``tags`` holds for each tag its words and for each scenario the number of its word, which is
    ``unknown`` where it has none.

    Args:
        runs: Evaluations, the policy last.
        tags: The tags of scenarios.
        played: The scenarios that the player holds, and their place there.
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


def _metric(name: str, runs: Sequence[Evaluation]) -> dict[str, Any]:
    entry = note(name, runs)
    bad = {"up": 0, "down": 1, "none": None}[entry.better] if name in RATES else None
    return {"name": name, "label": entry.label, "better": entry.better, "unit": entry.unit, "bad": bad}


def _run(
    run: Evaluation, runs: Sequence[Evaluation], names: Sequence[str], place: Mapping[ScenarioKey, int]
) -> dict[str, Any]:
    rows = worst_first(run, [other for other in runs if other is not run])
    outcomes = [outcome(run, row) for row in rows]
    words = list(dict.fromkeys(outcomes))
    scenarios = run.scenarios
    crashes = {(crash.dataset, crash.scenario_id): (crash.step, crash.error) for crash in run.crashes}
    return {
        "name": run.name,
        "playable": comparable(run, runs[-1]),
        "scenario": [place[scenarios[row]] for row in rows],
        "outcomes": words,
        "outcome": [words.index(word) for word in outcomes],
        "errors": {
            str(place): crashes[scenarios[row]] for place, row in enumerate(rows) if scenarios[row] in crashes
        },
        "values": [_column(run.metrics.get(name), rows) for name in names],
    }


def _column(values: Any, rows: Sequence[int]) -> list[float | None]:
    if values is None:
        return [None] * len(rows)
    return [None if np.isnan(value) else _short(value) for value in np.asarray(values)[rows]]


def _short(value: float) -> float:
    """Four significant digits; whole numbers as such, which are shorter."""
    short = float(f"{value:.4g}")
    return int(short) if short.is_integer() else short


def _tags(tagged: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    found = []
    for name in dict.fromkeys(name for words in tagged for name in words):
        said = [one.get(name, UNKNOWN) for one in tagged]
        words = sorted(set(said))
        if 1 < len(words) <= MOST_VALUES:
            number = {word: place for place, word in enumerate(words)}
            found.append({"name": name, "words": words, "of": [number[word] for word in said]})
    return found
