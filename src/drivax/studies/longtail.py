"""The long-tail study: does training on critical moments more often make a safer driver?

Agents that differ in how recorded steps are drawn are trained with several seeds under one budget, drive one test set,
and are compared scenario by scenario. What is done is not done again: a study that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivax.curation.arms import ARMS, weighted
from drivax.curation.logged import score_steps
from drivax.curation.methods import Request, check_current, curate, event_kinds
from drivax.curation.rarity import ExpertActions
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.curation.subset import top_rows
from drivax.curation.weights import draw_statistics
from drivax.errors import UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.files import write_text
from drivax.learning.config import TrainConfig
from drivax.learning.experience import WeightedSet
from drivax.learning.loop import hashes, train, usable_steps
from drivax.learning.training_log import rank
from drivax.report.pages.viewer import criticality_html, write_player
from drivax.scenario.store import ScenarioSet
from drivax.studies.longtail_drives import (
    BY_MEAN_Q,
    CRITICAL,
    DRIVES,
    FIRST,
    MEAN_Q,
    REFERENCES,
    REPORT,
    RESULTS,
    SCORES,
    Job,
    Log,
    LongtailConfig,
    Sets,
    Usable,
    clusters,
    episodes,
    evaluate_arm,
    evaluate_references,
    evaluation_of,
    is_evaluated,
    ordinary_share,
    rare_rows,
    run_of,
    test_set,
)
from drivax.studies.longtail_page import write_page
from drivax.studies.longtail_results import (
    METRICS,
    Condition,
    claims,
    cost_of_rule,
    detectable,
    judge,
    rankings,
    rates,
    summary,
)
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import read_rows
from drivax.tracking.workers import one_core_each

_PROGRESS = "validation/progress_ratio"
#: Methods whose most critical scenarios can be watched, and how many of each.
_SHOWN, _TOP = ("kinematic", "ensemble", "action_rarity"), 3


def open_study(config: LongtailConfig, sets: Sets, out: Path) -> None:
    """Makes the folder of a study, or finds that it is of this very study.

    Raises:
        UsageError: It is of another one, or an arm needs labels that the training set does not have.
        DataError: A set is no scenario set.
    """
    data = [ScenarioSet.open(path) for path in (sets.train, sets.validation, *sets.test)]
    if not out.exists():
        rest = [name for name in config.arms if ARMS[name].method != "oracle"]
        if len(rest) < len(config.arms) and not event_kinds(data[0]).any():
            raise UsageError(
                "has no labelled events, which the oracle and its control need",
                file=sets.train,
                cure=f"pass --arms [{','.join(rest)}]",
            )
        RunFolder.create(out, config, data, kind="longtail")
        return
    folder = RunFolder.open(out)
    hashes = [entry["hash"] for entry in folder.info.get("data", [])]
    if folder.config(LongtailConfig) != config or hashes != [one.hash for one in data]:
        raise UsageError(
            "holds a study with other settings, or of other scenarios", file=out, cure="choose another name"
        )


def score(config: LongtailConfig, sets: Sets, out: Path, log: Log) -> dict[str, ScoreTable]:
    """The tables of all methods that the arms ask for, of the training set; read where they are there already."""
    data, tables = ScenarioSet.open(sets.train), {}
    for method in dict.fromkeys(ARMS[arm].method for arm in config.arms):
        file = out / SCORES / f"{method}.npz"
        own = config.ensemble if method == "ensemble" else None
        if not file.is_file():
            log(f"scoring by {method}")
            write_scores(curate(method, Request(data, config=own)), file)
        tables[method] = read_scores(file, data)
        check_current(tables[method], own, file)
    return tables


def make_all(jobs: Sequence[Job], cores: int | None, log: Log) -> None:
    """Trains arms that are not trained yet and drives the test set with them, each seed by itself on one core."""
    waiting = [job for job in jobs if not _done(job)]
    for number, (job, took) in enumerate(one_core_each(_make, waiting, cores), start=1):
        log(f"trained and evaluated {job.arm}, seed {job.seed} in {took:.0f} s ({number} of {len(waiting)})")


def _done(job: Job) -> bool:
    """Whether an arm has episodes.

    Raises:
        UsageError: It was trained otherwise, or again since.
    """
    if not (job.run / "config.yaml").is_file():
        return False
    config, folder = job.train_config, RunFolder.open(job.run)
    now = hashes(ScenarioSet.open(job.sets.validation), _weighted(job).weights)
    if folder.config(TrainConfig) != config or any(folder.info.get(name) != one for name, one in now.items()):
        raise UsageError(
            "was trained with other settings or weights than this study asks for", file=job.run,
            cure=f"remove it and {evaluation_of(job.out, job.arm, job.seed)}; both are made again",
        )  # fmt: skip
    return is_evaluated(job.out, job.arm, job.seed)


def _weighted(job: Job) -> WeightedSet:
    data = ScenarioSet.open(job.sets.train)

    def table(method: str) -> ScoreTable:
        return read_scores(job.out / SCORES / f"{method}.npz", data)

    return weighted(ARMS[job.arm], data, table, job.config.weights, job.usable, job.seed)


def _make(job: Job) -> float:
    started, config = time.perf_counter(), job.train_config
    steps = Checkpoints(job.run / "checkpoints").steps()
    if config.iterations * config.algorithm.steps_per_iteration not in steps:
        validation = ScenarioSet.open(job.sets.validation)
        train(config, _weighted(job), job.run, validation=validation, resume=bool(steps), overwrite=not steps)
    evaluate_arm(job.out, job.arm, job.seed)
    return time.perf_counter() - started


def study(
    config: LongtailConfig,
    sets: Sets,
    out: Path,
    *,
    cores: int | None = None,
    anyway: bool = False,
    log: Log = print,
) -> dict[str, Any]:
    """Runs a study from wherever it is to its end; see the module.

    Args:
        config: What is compared.
        sets: The scenario sets.
        out: Its folder.
        cores: How many trainings run side by side; None: one on every core.
        anyway: Go on where the conditions for a comparison are not met; the report says so.
        log: Called with a line about every step.

    Returns:
        What ``results.json`` holds.

    Raises:
        UsageError: ``baseline`` or ``bc`` do not drive well enough, or ``out`` holds another study.
    """
    open_study(config, sets, out)
    tables = score(config, sets, out, log)
    data, test = ScenarioSet.open(sets.train), test_set(sets, out)
    # Of one observation and one action space: whichever arm is asked.
    usable = usable_steps(config.train_config(FIRST[0], 0), data)
    evaluate_references(out, test, log)
    jobs = [Job(config, sets, out, arm, seed, usable) for seed in range(config.seeds) for arm in config.arms]
    make_all([job for job in jobs if job.arm in FIRST], cores, log)
    met, least = conditions(config, out, FIRST), _detectable(config, sets, out)
    for one in met:
        log(one.words())
    log(
        "smallest difference that will be found: " + ", ".join(f"{name} {x:.3f}" for name, x in least.items())
    )
    if not all(one.met for one in met) and not anyway:
        raise UsageError(
            "the baseline does not drive well enough, so that a comparison would log little",
            file=out,
            cure="train longer, choose other settings, or pass --anyway",
        )
    make_all(jobs, cores, log)
    results = findings(config, sets, out, tables, usable) | {
        "conditions": [asdict(one) for one in conditions(config, out, config.arms)],
        "detectable": least,
    }
    write_text(out / RESULTS, json.dumps(results, indent=1) + "\n")
    _show(results, data, tables, out)
    log(f"wrote {out / REPORT}")
    return results


def _detectable(config: LongtailConfig, sets: Sets, out: Path) -> dict[str, float]:
    """See :func:`detectable`: of the claims against the baseline."""
    test = test_set(sets, out)
    evaluated, imitated = (episodes(config, out, name) for name in FIRST)
    together = max([claim.group for claim in claims(config.arms)].count("baseline"), 1)
    return detectable(
        evaluated, imitated, clusters(test), rare_rows(config, test), ordinary_share(sets), together
    )


def _show(results: Mapping[str, Any], data: ScenarioSet, tables: Mapping[str, ScoreTable], out: Path) -> None:
    """Writes the report, and the player of the most critical drives."""
    expert = score_steps(data, ExpertActions())
    write_page(results, tables, expert["action"][expert["known"]], out / REPORT)
    tops = {row: tables[name] for name in _SHOWN if name in tables for row in top_rows(tables[name], _TOP)}
    write_player(
        [data[row] for row in tops],
        out / CRITICAL,
        overwrite=True,
        title="most critical drives",
        details=[criticality_html(table, row) for row, table in tops.items()],
    )


def conditions(config: LongtailConfig, out: Path, arms: Sequence[str]) -> list[Condition]:
    """Whether arms drive well, and no longer learn; what everything is compared with has to."""
    found = []
    for arm in arms:
        found.append(Condition.of(arm, validations(config, out, arm), config.progress, config.flat))
    return found


def validations(config: LongtailConfig, out: Path, arm: str) -> list[dict[str, list[float]]]:
    """Of each seed ``score``, ``progress`` and, if there are critics, ``mean_q`` at its validations in their order."""
    found = []
    for seed in range(config.seeds):
        rows = [row for row in read_rows(run_of(out, arm, seed) / "metrics.jsonl") if _PROGRESS in row]
        found.append(
            {
                "score": [_score(row) for row in rows],
                "progress": [row[_PROGRESS] for row in rows],
                "mean_q": [row[MEAN_Q] for row in rows if MEAN_Q in row],
            }
        )
    return found


def _score(row: Mapping[str, float]) -> float:
    found = rank("score", row)
    assert found is not None
    return found[0]


def findings(
    config: LongtailConfig, sets: Sets, out: Path, tables: Mapping[str, ScoreTable], usable: Usable
) -> dict[str, Any]:
    """Everything that the study found in the end, as plain values."""
    data, test = ScenarioSet.open(sets.train), test_set(sets, out)
    rare, labels, share = rare_rows(config, test), clusters(test), ordinary_share(sets)
    drives = {name: episodes(config, out, name) for name in (*config.arms, BY_MEAN_Q)}
    for name in REFERENCES:
        evaluated = EpisodeTable.read(out / DRIVES / name).metrics
        drives[name] = {metric: evaluated[metric][None] for metric in METRICS}
    by_mean_q = drives[BY_MEAN_Q]
    return {
        "about": {
            "seeds": config.seeds,
            "train": len(data),
            "test": len(test),
            "rare": int(rare.sum()),
            "labelled": share is not None,
            "share": share,
        },
        "claims": [summary(one) for one in judge(drives, labels, rare, config.arms, share)],
        "rates": {name: rates(drives[name], labels, rare, share) for name in (*REFERENCES, *config.arms)},
        "draws": {
            name: asdict(
                draw_statistics(
                    weighted(ARMS[name], data, tables.__getitem__, config.weights, usable).weights, usable
                )
            )
            for name in config.arms
        },
        "rankings": rankings(tables, clusters(data)),
        "mean_q": cost_of_rule(by_mean_q, drives["baseline"], labels, rare, share),
        "validations": validations(config, out, "baseline"),
    }
