"""Compute what the runs of the long-tail study show beyond its claims: critics, comparisons with BC, collisions.

python -m experiments.longtail restore longtail --out STUDY
drivax generate BENCHMARK --benchmark
python -m experiments.longtail_supplement compute --out STUDY --data BENCHMARK
python -m experiments.longtail_supplement page       (write the tables and the picture of the page)

The comparisons were chosen after the results were known, and their p-values are not adjusted, so they are no verdicts.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from drivax import settings
from drivax.evaluation.episode_table import EpisodeTable
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.config import TrainConfig
from drivax.learning.policies import find_traffic
from drivax.report.charts import format_compact
from drivax.report.pictures.palette import LIGHT, SERIES
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet
from drivax.stats.clusters import recordings
from drivax.stats.seeds import crossed_difference
from drivax.studies.definition import Stratum, Study, StudySets, load_study
from drivax.studies.verdicts import Strata
from drivax.tracking.run_folder import RunFolder
from experiments.learning.tables import interval, table
from experiments.longtail import PAGES, result_file, stored_study
from experiments.repository import RESULTS, save_picture

DEFINITION, PAGE = load_study("longtail"), PAGES["longtail"]
RESULT = RESULTS / "longtail_supplement.json"
PICTURE = PAGE.parent / "longtail-critics.png"
BEGIN, END = "<!-- longtail_supplement.py: {} -->", "<!-- longtail_supplement.py: end -->"
#: Logged metrics of the critics, and their names on the page.
CURVES = {
    "loss/critic": "half the squared TD error",
    "loss/temperature": "temperature",
    "loss/entropy": "entropy",
    "loss/mean_q": "mean Q, logged actions",
    "loss/mean_q_policy": "mean Q, policy's actions",
    "loss/mean_q_uniform": "mean Q, uniform actions",
}
#: Metrics of the picture.
PANELS = ("loss/critic", "loss/temperature", "loss/mean_q")
#: Every n-th iteration is stored, and every n-th stored one is a validation.
STRIDE, VALIDATION = 3, 5
#: Kinds of test scenarios, by what their recording begins with.
KINDS = {"event": "labelled event", "critical": "no event, critical moment", "other": "neither"}
Values = dict[str, np.ndarray]


def critic_curves(study: Study) -> dict[str, Any]:
    """Return training curves: of the baseline by seed, of the other arms with critics the mean over seeds."""
    rows = {arm: [_rows(study, arm, seed) for seed in range(study.config.seeds)] for arm in study.arms}
    critics = {arm: seeds for arm, seeds in rows.items() if PANELS[0] in seeds[0][0]}
    curves = {
        arm: {name: np.array([[row[name] for row in seed] for seed in seeds]) for name in CURVES}
        for arm, seeds in critics.items()
    }
    baseline = DEFINITION.baselines[0]
    return {
        "steps": [row["step"] for row in critics[baseline][0]],
        "seeds": {name: _round_nested(values) for name, values in curves[baseline].items()},
        "arms": {
            arm: {name: _round_nested(values[name].mean(axis=0)) for name in PANELS}
            for arm, values in curves.items()
        },
    }


def _rows(study: Study, arm: str, seed: int) -> list[dict[str, float]]:
    """Return every ``STRIDE``-th row of the metrics of a run."""
    return list(RunFolder(study.run(arm, seed), {}).metric_rows())[STRIDE - 1 :: STRIDE]


def _round_nested(values: np.ndarray) -> list[Any]:
    """Return nested lists of numbers with four significant digits."""
    return [_round_nested(value) if value.ndim else float(f"{value:.4g}") for value in np.asarray(values)]


def evaluations(study: Study) -> tuple[dict[str, Values], Strata, tuple[str, ...]]:
    """Return values ``[seed, scenario]`` by arm and metric, the strata, and the ids of the test scenarios."""
    about = json.loads(result_file("longtail").read_text())["about"]
    metrics = ("collision", "progress_ratio")
    tables = {
        arm: [EpisodeTable.read(study.evaluation(arm, seed)) for seed in range(about["seeds"])]
        for arm in study.arms
    }
    values = {
        arm: {name: np.stack([episodes.metrics[name] for episodes in seeds]) for name in metrics}
        for arm, seeds in tables.items()
    }
    keys = tables[DEFINITION.baselines[0]][0].keys
    labels = recordings(keys["dataset"], keys["segment"], keys["scenario_id"])
    # The world names the recordings of scenarios with an event by "r", the others by their map.
    rare = np.array([segment.split("-")[-1].startswith("r") for segment in keys["segment"]])
    if int(rare.sum()) != about["rare"]:
        raise SystemExit(f"{rare.sum()} test scenarios have an event; the study has {about['rare']}")
    return values, Strata(labels, rare, about["share"]), keys["scenario_id"]


def differences_from_bc(episodes: Mapping[str, Values], strata: Strata) -> dict[str, Any]:
    """Return collisions of each arm minus those of BC, by stratum, with unadjusted p-values."""
    differences: dict[str, Any] = {}
    for arm, values in episodes.items():
        if arm == "bc":
            continue
        differences[arm] = {}
        for stratum in get_args(Stratum):
            weights = strata.weights(stratum)
            effect = crossed_difference(
                values["collision"], episodes["bc"]["collision"], strata.recordings, weights
            )
            low, high = effect.interval()
            differences[arm][stratum] = {"mean": effect.difference, "low": low, "high": high, "p": effect.p}
    return differences


def progress_correlations(episodes: Mapping[str, Values], strata: Strata) -> dict[str, Any]:
    """Return correlations, over arms, of collisions in rare or common scenarios with progress in either."""

    def means(metric: str, mask: np.ndarray) -> np.ndarray:
        return np.array([values[metric][:, mask].mean() for values in episodes.values()])

    masks = {"rare": strata.rare, "common": ~strata.rare}
    return {"arms": len(episodes)} | {
        collisions: {
            progress: float(
                np.corrcoef(means("collision", masks[collisions]), means("progress_ratio", mask))[0, 1]
            )
            for progress, mask in masks.items()
        }
        for collisions in masks
    }


def collisions_by_kind(
    episodes: Mapping[str, Values], strata: Strata, ids: Sequence[str], sets: Sequence[ScenarioSet]
) -> dict[str, Any]:
    """Return, by kind of scenario, their number, their share of ordinary traffic, and each arm's rate of collisions."""
    tags = {entry["scenario_id"]: entry["tags"] for scenarios in sets for entry in scenarios.entries}
    kinds = np.array(
        [
            "event" if "event" in tags[name] else "critical" if "critical" in tags[name] else "other"
            for name in ids
        ]
    )
    if not np.array_equal(kinds == "event", strata.rare):
        raise SystemExit("the scenarios with an event are not those of the study")
    weights = strata.weights("ordinary")
    weights = weights / weights.sum()
    rates = {arm: values["collision"].mean(axis=0) for arm, values in episodes.items()}
    return {
        kind: {
            "scenarios": int((kinds == kind).sum()),
            "share": float(weights[kinds == kind].sum()),
            "rates": {arm: float(rate[kinds == kind].mean()) for arm, rate in rates.items()},
        }
        for kind in KINDS
    }


def logged_rewards(train: ScenarioSet) -> dict[str, Any]:
    """Return failures, rewards and discounted returns of the logged steps that the arms learn from.

    A return continues the last reward of a log forever, because the critics bootstrap there.
    """
    config = settings.load(TrainConfig, "offline/cql")
    assert isinstance(config.algorithm, CqlConfig)
    environment = config.environment(find_traffic("log"))
    steps = environment.expert_steps(environment.prepare(ScenarioBank.from_scenarios(train)))
    usable, terminated = np.asarray(steps.usable), np.asarray(steps.terminated)
    reward, gamma = np.where(usable, steps.reward, 0.0), config.algorithm.gamma
    has_next = np.pad(usable[:, 1:], ((0, 0), (0, 1))) & ~terminated
    returns, later = np.zeros_like(reward), np.zeros(len(reward))
    for step in reversed(range(reward.shape[1])):
        last = np.where(terminated[:, step], 1.0, 1.0 / (1.0 - gamma)) * reward[:, step]
        later = np.where(has_next[:, step], reward[:, step] + gamma * later, last)
        returns[:, step] = later
    return {
        "steps": int(usable.sum()),
        "failures": int((usable & terminated).sum()),
        "negative": int((usable & (reward < 0.0)).sum()),
        "largest": float(reward[usable].max()),
        "mean": float(reward[usable].mean()),
        "return": float(returns[usable].mean()),
        "discount": gamma,
    }


def page_tables(results: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the tables of the page, by the names of their markers."""
    return {
        "critics": _critics_table(results["critics"]),
        "against bc": _bc_table(results["against_bc"]),
        "progress": _progress_table(results["progress"]),
        "kinds": _kinds_table(results["kinds"]),
        "rewards": _rewards_table(results["rewards"]),
    }


def _critics_table(critics: Mapping[str, Any]) -> list[str]:
    """Return the baseline's curves at the validations: mean over seeds, and the range at the end."""
    validations = slice(VALIDATION - 1, None, VALIDATION)
    steps = [format_compact(step) for step in critics["steps"][validations]]
    rows = []
    for name, label in CURVES.items():
        values = np.array(critics["seeds"][name])[:, validations]
        cells = [f"{value:.2f}" for value in values.mean(axis=0)]
        rows.append([label, *cells, f"{values[:, -1].min():.2f} to {values[:, -1].max():.2f}"])
    return table(["logged steps drawn", *steps, "seeds at the end"], rows)


def _bc_table(differences: Mapping[str, Any]) -> list[str]:
    """Return the collisions of each arm minus those of BC."""
    strata = {"ordinary": "ordinary traffic", "common": "without an event", "rare": "with an event"}
    rows = [
        [arm, *(interval(values[stratum], signed=True) for stratum in strata)]
        for arm, values in differences.items()
    ]
    return table(["arm minus `bc`", *strata.values()], rows)


def _progress_table(correlations: Mapping[str, Any]) -> list[str]:
    """Return the correlations of collisions with progress."""
    names = {"rare": "with an event", "common": "without an event"}
    rows = [
        [f"collisions {label}", *(f"{correlations[name][progress]:+.2f}" for progress in names)]
        for name, label in names.items()
    ]
    return table(["", *(f"progress {label}" for label in names.values())], rows)


def _kinds_table(kinds: Mapping[str, Any]) -> list[str]:
    """Return collisions by kind of scenario: rates, and shares of all collisions in ordinary traffic."""
    arms = ("baseline", "bc", "oracle")
    totals = {arm: sum(kind["share"] * kind["rates"][arm] for kind in kinds.values()) for arm in arms}
    rows = []
    for name, label in KINDS.items():
        kind = kinds[name]
        cells = [
            f"{kind['rates'][arm]:.3f} ({kind['share'] * kind['rates'][arm] / totals[arm]:.0%})"
            for arm in arms
        ]
        rows.append([label, str(kind["scenarios"]), f"{kind['share']:.0%}", *cells])
    return table(["scenarios", "in the test", "of ordinary traffic", *(f"`{arm}`" for arm in arms)], rows)


def _rewards_table(rewards: Mapping[str, Any]) -> list[str]:
    """Return what the logged steps hold."""
    rows = [
        ["logged steps", f"{rewards['steps']:,}"],
        ["steps that end in a failure", f"{rewards['failures']:,}"],
        ["steps with a negative reward", f"{rewards['negative']:,}"],
        ["largest reward of a step", f"{rewards['largest']:.3f}"],
        ["mean reward of a step", f"{rewards['mean']:.3f}"],
        [f"mean discounted return (discount {rewards['discount']:g})", f"{rewards['return']:.2f}"],
    ]
    return table(["quantity", "value"], rows)


def draw_critics(critics: Mapping[str, Any]) -> Figure:
    """Draw TD error, temperature and mean Q during training: the baseline's seeds, and the other arms' means."""
    figure = Figure(figsize=(9.6, 3.2), dpi=100, facecolor="white", layout="constrained")
    steps, baseline = critics["steps"], DEFINITION.baselines[0]
    for axes, name in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        others = [curves[name] for arm, curves in critics["arms"].items() if arm != baseline]
        for number, values in enumerate(others):
            label = f"{len(others)} other arms (mean)" if number == 0 else None
            axes.plot(steps, values, color=LIGHT["parked"], linewidth=0.8, label=label)
        for number, values in enumerate(critics["seeds"][name]):
            axes.plot(steps, values, color=SERIES[number], linewidth=1.3, label=f"{baseline}, seed {number}")
        axes.set(xlabel="logged steps drawn", title=CURVES[name], xlim=(0, steps[-1]))
        axes.title.set(fontsize=10, color=LIGHT["ink"])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: format_compact(value)))
        axes.grid(color=LIGHT["crosswalk"])
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[-1].legend(frameon=False, fontsize=7, loc="lower left")
    return figure


def fill_page(page: str, results: Mapping[str, Any]) -> str:
    """Return the page with the tables of the results."""
    for name, lines in page_tables(results).items():
        before, rest = page.split(BEGIN.format(name))
        page = "\n".join([before + BEGIN.format(name), "", *lines, "", END + rest.split(END, 1)[1]])
    return page


def compute(folder: Path, data: Path) -> dict[str, Any]:
    """Return the results of a study's folder and of the benchmark's scenarios."""
    study, sets = stored_study("longtail", folder), StudySets.of(data, None, ())
    episodes, strata, ids = evaluations(study)
    return {
        "critics": critic_curves(study),
        "against_bc": differences_from_bc(episodes, strata),
        "progress": progress_correlations(episodes, strata),
        "kinds": collisions_by_kind(episodes, strata, ids, [ScenarioSet.open(path) for path in sets.test]),
        "rewards": logged_rewards(ScenarioSet.open(sets.train)),
    }


def main() -> None:
    """Compute the results, or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("compute", "page"))
    parser.add_argument("--out", type=Path, help="the study's folder")
    parser.add_argument("--data", type=Path, help="the benchmark's scenario sets")
    args = parser.parse_args()
    if args.what == "page":
        results = json.loads(RESULT.read_text())
        PAGE.write_text(fill_page(PAGE.read_text(), results))
        save_picture(draw_critics(results["critics"]), PICTURE)
    elif args.out is None or args.data is None:
        parser.error("compute needs --out and --data")
    else:
        RESULT.write_text(_dump(compute(args.out, args.data)))


def _dump(results: Mapping[str, Any]) -> str:
    """Return JSON with one line per list of numbers."""
    text = json.dumps(results, indent=1)
    return re.sub(r"\[[\d\s.,e+-]+\]", lambda match: re.sub(r"\s+", " ", match[0]), text) + "\n"


if __name__ == "__main__":
    main()
