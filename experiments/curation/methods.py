"""Evaluate every curation method against the event labels of the built-in world's benchmark.

    drivax generate sets/bench --benchmark
    python -m experiments.curation.methods events --bench sets/bench [--method NAME ...]
    python -m experiments.curation.methods check --data sets/bench/validation sets/fresh
    python -m experiments.curation.methods speed --data sets/bench/train sets/womd
    python -m experiments.curation.methods table

``events`` scores both test sets and stores the result; ``table`` writes it to the page.
``check`` ranks scenarios of other sets by ``kinematic``: those used to choose its weights, and new ones (``drivax
generate sets/fresh --scenarios 1024 --seed 20261129 --rare_rate 0.5``).
Scenarios without an event come from ``test``, those with one from ``test`` and ``test-rare``. Measures are weighted to
the natural share of events, so precision is that of an ordinary set. The density of actions comes from ``test`` alone;
ensembles are trained on ``train``. ``--method`` scores only the named methods and keeps the results of others.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax import settings
from drivax.curation.ensemble import Ensemble, EnsembleConfig, train_ensemble
from drivax.curation.kinematic import KinematicConfig, PublishedConfig
from drivax.curation.logged import BATCH, score_steps
from drivax.curation.methods import (
    Request,
    curate,
    ensemble_table,
    event_kinds,
    event_steps,
    make_table,
    permute_scores,
)
from drivax.curation.rarity import (
    ExpertActions,
    KernelRarity,
    PublishedRarity,
    known_actions,
    rarity_steps,
)
from drivax.curation.scores import ScoreTable
from drivax.curation.weights import WeightConfig, draw_statistics, sampling_weights
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.store import ScenarioSet
from drivax.stats.ranking import (
    auc_interval,
    bootstrap_intervals,
    correlation_interval,
    precision_at_base_rate,
    roc_auc,
)
from drivax.synthetic.events import EventKind
from experiments.repository import DOCS, RESULTS

STORED = RESULTS / "curation.json"
PAGE = DOCS / "results" / "curation.md"
BEGIN, END = "<!-- methods.py: {} -->", "<!-- methods.py: end -->"
#: Minimum required braking of an event that forces a reaction: IDM's comfortable braking, m/s2.
FORCED_MPS2 = 3.0
METHODS = (
    "kinematic", "published", "ensemble", "ensemble_mixture", "action_rarity", "action_rarity_published"
)  # fmt: skip
#: Ensemble of point estimates, and of mixtures, which can disagree about modes.
ENSEMBLES = {
    "ensemble": EnsembleConfig(),
    "ensemble_mixture": settings.load(
        EnsembleConfig, {}, ["--cloning.loss", "likelihood", "--cloning.network.distribution", "mixture"]
    ),
}
#: Share of scenarios with an event in an ordinary set (``WorldConfig.rare_rate``).
NATURAL_RATE = 0.05


@dataclass(frozen=True)
class Truth:
    """Facts of the scenarios of both test sets: kind, severity and steps of the event, valid steps of ego."""

    kind: Any
    severity: Any
    during: Any
    valid: Any

    @classmethod
    def of(cls, sets: list[ScenarioSet]) -> Truth:
        """Return the facts of several sets, concatenated."""
        entries = [entry for data in sets for entry in data.entries]
        return cls(
            np.concatenate([event_kinds(data) for data in sets]),
            np.array([float(entry["tags"].get("severity_mps2", 0.0)) for entry in entries]),
            np.concatenate([event_steps(data) for data in sets]),
            np.concatenate([[s.record["agent_valid"][:, 0] for s in data] for data in sets]).astype(bool),
        )

    def groups(self) -> dict[str, Any]:
        """Return masks of scenarios to detect: all events, with and without a forced reaction, and each kind."""
        is_forced = self.severity >= FORCED_MPS2
        groups = {
            "all": self.kind > 0, "forced": (self.kind > 0) & is_forced, "mild": (self.kind > 0) & ~is_forced
        }  # fmt: skip
        return groups | {kind.name.lower(): self.kind == kind for kind in EventKind if kind}


def measure_detection(truth: Truth, events: Any, steps: Any, scenarios: Any) -> dict[str, Any]:
    """Measure how well scores detect a group of events among scenarios without an event, at both scales."""
    rows = events | (truth.kind == 0)
    label = events[rows]
    weight = np.where(label, NATURAL_RATE / label.sum(), (1 - NATURAL_RATE) / (~label).sum())
    _, precision = bootstrap_intervals(scenarios[rows], label, weight, np.arange(len(label)))
    valid = truth.valid[rows]
    step_label = (truth.during & events[:, None])[rows][valid]
    step_weight = np.broadcast_to(weight[:, None], valid.shape)[valid]
    step_scores = steps[rows][valid]
    scenario = np.broadcast_to(np.arange(len(label))[:, None], valid.shape)[valid]
    step_auc, step_precision = bootstrap_intervals(step_scores, step_label, step_weight, scenario)
    return {
        "scenarios": int(label.sum()),
        "auc": roc_auc(scenarios[rows], label),
        "auc_interval": auc_interval(scenarios[rows], label),
        "precision": precision_at_base_rate(scenarios[rows], label, weight),
        "precision_interval": precision,
        "step_auc": roc_auc(step_scores, step_label, step_weight),
        "step_auc_interval": step_auc,
        "step_precision": precision_at_base_rate(step_scores, step_label, step_weight),
        "step_precision_interval": step_precision,
        "step_rate": float(step_weight[step_label].sum() / step_weight.sum()),
    }


def measure_events(bench: Path, only: list[str], results: dict[str, Any]) -> dict[str, Any]:
    """Evaluate methods (default: all) on both test sets and merge them with stored results."""
    sets = [ScenarioSet.open(bench / name) for name in ("test", "test-rare")]
    hashes = {data.path.name: data.hash for data in sets}
    if only and results.get("sets") != hashes:
        raise SystemExit("the stored results are from other sets: score all methods, without --method")
    truth = Truth.of(sets)
    methods = dict(results["methods"]) if only else {}
    for name, test_table, table in score_methods(sets, bench / "train", only or list(METHODS)):
        methods[name] = measure_method(truth, table) | {"draws": weight_statistics(test_table)}
        methods[name] |= {
            key: value for key, value in test_table.config.items() if key.startswith("error_rank_")
        }
        if name == "kinematic":
            methods["random_matched"] = measure_method(truth, permute_scores(table, 0)) | {
                "draws": weight_statistics(permute_scores(test_table, 0))
            }
        print(f"{name}: {methods[name]['events']['forced']['auc']:.3f}", flush=True)
    return {"sets": hashes, "forced_mps2": FORCED_MPS2, "natural": NATURAL_RATE, "methods": methods}


def score_methods(
    sets: list[ScenarioSet], train: Path, names: list[str]
) -> Iterator[tuple[str, ScoreTable, ScoreTable]]:
    """Yield each method with the score tables of the first set and of all sets concatenated."""
    for name in ("kinematic", "published"):
        if name in names:
            tables = [curate(name, Request(data)) for data in sets]
            yield name, tables[0], concatenate_tables(tables)
    for name in ("ensemble", "ensemble_mixture"):
        if name in names:
            ensemble = train_ensemble(ENSEMBLES[name], ScenarioSet.open(train))
            first = ensemble_table(ensemble, sets[0])
            rest = [ensemble_table(ensemble, data, scale=first.config["scale"]) for data in sets[1:]]
            interval = {"error_rank_interval": error_interval(ensemble, first, sets[0])}
            yield (
                name,
                replace(first, config={**first.config, **interval}),
                concatenate_tables([first, *rest]),
            )
    rarities = {"action_rarity": KernelRarity(), "action_rarity_published": PublishedRarity()}
    if not rarities.keys() & set(names):
        return
    actions = [score_steps(data, ExpertActions()) for data in sets]
    for name, config in rarities.items():
        histogram = config.histogram(known_actions(actions[0]["action"], actions[0]["known"]))
        tables = []
        for data, expert in zip(sets, actions, strict=True):
            steps = rarity_steps(config, expert["action"], expert["known"], histogram)
            tables.append(make_table(name, config, data, {"rarity": steps}))
        yield name, tables[0], concatenate_tables(tables)


def check_sets(paths: list[Path]) -> dict[str, Any]:
    """Measure how well ``kinematic`` detects events that force a reaction, by set."""
    results = {}
    for path in paths:
        data = ScenarioSet.open(path)
        truth, scores = Truth.of([data]), curate("kinematic", Request(data)).scenarios
        events = truth.groups()["forced"]
        rows = events | (truth.kind == 0)
        results[path.name] = {
            "hash": data.hash,
            "scenarios": int(rows.sum()),
            "events": int(events.sum()),
            "auc": roc_auc(scores[rows], events[rows]),
            "auc_interval": auc_interval(scores[rows], events[rows]),
        }
    return {"checks": results}


def error_interval(ensemble: Ensemble, table: ScoreTable, data: ScenarioSet) -> tuple[float, float]:
    """Return the bootstrap 95 % interval, over scenarios, of the rank correlation of step scores and errors."""
    predictions = ensemble.predictions(data)
    error, known = predictions.error(ensemble.deviation, None), predictions.known
    return correlation_interval(table.steps[known], error[known], np.nonzero(known)[0])


def concatenate_tables(tables: list[ScoreTable]) -> ScoreTable:
    """Concatenate score tables."""
    first = tables[0]
    arrays = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ("valid", "steps", "scenarios")
    }
    ids = sum((table.scenario_ids for table in tables), ())
    return ScoreTable(first.method, first.config, "both", ids, **arrays)


def measure_method(truth: Truth, table: ScoreTable) -> dict[str, Any]:
    """Measure one method on every group of events."""
    return {
        "events": {
            name: measure_detection(truth, events, table.steps, table.scenarios)
            for name, events in truth.groups().items()
        }
    }


def weight_statistics(table: ScoreTable) -> dict[str, Any]:
    """Return statistics of the default weights of a table."""
    return {
        scale: vars(draw_statistics(sampling_weights(table, WeightConfig(), scale), table.drawable))
        for scale in ("step", "scenario")
    }


def measure_speed(paths: list[Path], count: int) -> dict[str, Any]:
    """Time the scoring of ``count`` scenarios of each set, with reading and stacking, without compilation."""
    results: dict[str, Any] = {}
    for path in paths:
        distinct = list(ScenarioSet.open(path)[:count])
        data = (distinct * -(-count // len(distinct)))[:count]
        sizes = Sizes.used(data)
        result: dict[str, Any] = {"scenarios": count, "different": len(distinct)}
        # The first time includes reads from the disk.
        result["stacking_s"] = min(stacking_s(data, sizes) for _ in range(2))
        configs = {
            "kinematic": KinematicConfig(), "published": PublishedConfig(), "action_rarity": ExpertActions()
        }  # fmt: skip
        for name, config in configs.items():
            score_steps(data, config)
            cpu_start, wall_start = time.process_time(), time.perf_counter()
            score_steps(data, config)
            result[name] = {
                "cpu_s": time.process_time() - cpu_start,
                "wall_s": time.perf_counter() - wall_start,
            }
        results[path.name] = result
    return {"cores": len(os.sched_getaffinity(0)), "sets": results}


def stacking_s(data: list[Any], sizes: Sizes) -> float:
    """Return the CPU seconds to stack scenarios in batches, as scoring does."""
    start = time.process_time()
    for first in range(0, len(data), BATCH):
        ScenarioBank.from_scenarios(data[first : first + BATCH], trim=sizes)
    return time.process_time() - start


def events_table(results: dict[str, Any]) -> str:
    """Table by method: all events and those that force a reaction, at both scales."""
    lines = [
        "| method | events | scenarios: AUC | precision | steps: AUC | precision |",
        "|---|---|---|---|---|---|",
    ]
    for method, method_results in results["methods"].items():
        for group, words in (("forced", "that force a reaction"), ("mild", "that do not"), ("all", "all")):
            result = method_results["events"][group]
            measures = (("auc", 3), ("precision", 2), ("step_auc", 3), ("step_precision", 2))
            cells = " | ".join(format_cell(result, *measure) for measure in measures)
            lines.append(f"| `{method}` | {words} ({result['scenarios']}) | {cells} |")
    return "\n".join(lines)


def format_cell(result: dict[str, Any], measure: str, digits: int) -> str:
    """Format a value with its interval."""
    low, high = result[f"{measure}_interval"]
    return f"{result[measure]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def ensemble_checks_table(results: dict[str, Any]) -> str:
    """Table of the correlation of disagreement and errors."""
    lines = ["| ensemble | rank correlation of scores and errors, by step |", "|---|---|"]
    for name in ENSEMBLES:
        result = results["methods"][name]
        low, high = result["error_rank_interval"]
        lines.append(f"| `{name}` | {result['error_rank_correlation']:.2f} [{low:.2f}, {high:.2f}] |")
    return "\n".join(lines)


def checks_table(results: dict[str, Any]) -> str:
    """Table of ``kinematic`` on other sets."""
    lines = ["| set | scenarios | of them with an event that forces a reaction | AUC |", "|---|---|---|---|"]
    for name, result in results["checks"].items():
        lines.append(
            f"| `{name}` | {result['scenarios']} | {result['events']} | {format_cell(result, 'auc', 3)} |"
        )
    return "\n".join(lines)


def kinds_table(stored: dict[str, Any], measure: str, digits: int) -> str:
    """Table of one measure by kind of event and method."""
    methods = stored["methods"]
    kinds = [kind.name.lower() for kind in EventKind if kind]
    lines = ["| event | scenarios | " + " | ".join(f"`{name}`" for name in methods) + " |"]
    lines.append("|---|---|" + "---|" * len(methods))
    for kind in kinds:
        results = [method_results["events"][kind] for method_results in methods.values()]
        cells = " | ".join(format_cell(result, measure, digits) for result in results)
        lines.append(f"| `{kind}` | {results[0]['scenarios']} | {cells} |")
    return "\n".join(lines)


def draws_table(stored: dict[str, Any]) -> str:
    """Table of the effect of the default weights on an ordinary set."""
    lines = [
        "| method | scale | effective sample | of scenarios | tilt | largest | draws from 5 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, results in stored["methods"].items():
        for scale, draws in results["draws"].items():
            lines.append(
                f"| `{method}` | {scale} | {draws['effective']:.2f} | {draws['effective_scenarios']:.2f} | "
                f"{draws['tilt']:.2f} | {draws['largest']:.2f} | {draws['concentration']:.2f} |"
            )
    return "\n".join(lines)


def speed_table(stored: dict[str, Any]) -> str:
    """Table of seconds per 10,000 scenarios."""
    cores = stored["speed"]["cores"]
    lines = [
        f"| set | method | 10,000 scenarios on {cores} cores (s) | processor seconds | over stacking alone |",
        "|---|---|---|---|---|",
    ]
    for path, result in stored["speed"]["sets"].items():
        factor = 10_000 / result["scenarios"]
        for name in ("kinematic", "published", "action_rarity"):
            cpu, wall = (result[name][kind] * factor for kind in ("cpu_s", "wall_s"))
            ratio = cpu / factor / result["stacking_s"]
            lines.append(f"| `{path}` | `{name}` | {wall:,.0f} | {cpu:,.0f} | {ratio:.1f} |")
    return "\n".join(lines)


def fill_page(text: str, stored: dict[str, Any]) -> str:
    """Return the page with the stored tables."""
    tables = {
        "events": events_table(stored),
        "scenario auc": kinds_table(stored, "auc", 3),
        "scenario precision": kinds_table(stored, "precision", 2),
        "step auc": kinds_table(stored, "step_auc", 3),
        "step precision": kinds_table(stored, "step_precision", 2),
        "ensembles": ensemble_checks_table(stored),
        "checks": checks_table(stored),
        "draws": draws_table(stored),
        "speed": speed_table(stored),
    }
    for name, table in tables.items():
        before, rest = text.split(BEGIN.format(name))
        after = rest.split(END, 1)[1]
        text = f"{before}{BEGIN.format(name)}\n\n{table}\n\n{END}{after}"
    return text


def main() -> None:
    """Measure, or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("events", "check", "speed", "table"))
    parser.add_argument("--bench", type=Path)
    parser.add_argument("--method", nargs="+", choices=METHODS, default=[])
    parser.add_argument("--data", type=Path, nargs="+")
    parser.add_argument("--count", type=int, default=1024)
    args = parser.parse_args()
    stored = json.loads(STORED.read_text()) if STORED.exists() else {}
    if args.what == "table":
        PAGE.write_text(fill_page(PAGE.read_text(), stored))
        return
    if args.what == "events":
        results = measure_events(args.bench, args.method, stored)
    elif args.what == "check":
        results = check_sets(args.data)
    else:
        results = {"speed": measure_speed(args.data, args.count)}
    STORED.write_text(json.dumps(stored | results, indent=1) + "\n")


if __name__ == "__main__":
    main()
