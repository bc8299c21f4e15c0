"""The study runner: score, train, evaluate, test the claims, write the report.

Arms differ in how logged steps are drawn. Each is trained with several seeds under one budget and evaluated on one test
set; claims compare arms scenario by scenario. An interrupted study resumes without repeating finished work.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

import numpy as np
from jaxtyping import Bool

from drivax import settings
from drivax.curation.logged import score_steps
from drivax.curation.methods import Request, check_current, curate, event_kinds
from drivax.curation.rarity import ExpertActions
from drivax.curation.scores import ScoreTable, read_scores, write_scores
from drivax.curation.subset import top_rows
from drivax.curation.weights import draw_statistics
from drivax.errors import UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.files import write_json
from drivax.learning.config import TrainConfig
from drivax.learning.experience import WeightedSet
from drivax.learning.loop import hashes, train, usable_steps
from drivax.learning.policies import load_policy
from drivax.learning.training_log import rank
from drivax.planners.catalogue import make_planner
from drivax.report.pages.viewer import criticality_html, write_player
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet, ScenarioWriter, check_lengths
from drivax.stats.clusters import recordings_of
from drivax.studies.definition import Study, StudyConfig
from drivax.studies.report import write_report
from drivax.studies.verdicts import (
    Condition,
    Episodes,
    Strata,
    decide_claims,
    detectable,
    rankings,
    rates,
    rule_cost,
)
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import read_rows
from drivax.tracking.workers import one_core_each

_PROGRESS = "validation/progress_ratio"
#: Methods whose most critical scenarios the player shows, and the number of each.
_PLAYER_METHODS, _PLAYER_TOP = ("kinematic", "ensemble", "action_rarity"), 3
Log = Callable[[str], None]


@dataclass(frozen=True)
class Job:
    """One training of a study, and the logged steps that it draws from."""

    study: Study
    arm: str
    seed: int
    usable: Bool[np.ndarray, "N T"]

    def weighted(self) -> WeightedSet:
        """Return the training set with the arm's weights."""
        data = ScenarioSet.open(self.study.sets.train)

        def table(method: str) -> ScoreTable:
            return read_scores(self.study.scores(method), data)

        return self.study.arms[self.arm].weighted(
            data, table, self.study.config.weights, self.usable, self.seed
        )


def run_study(
    study: Study, *, cores: int | None = None, anyway: bool = False, log: Log = print
) -> dict[str, Any]:
    """Run a study, or resume it.

    Args:
        study: The study.
        cores: Number of parallel training runs; None: one per core.
        anyway: Continue even if the baselines do not meet their conditions; the report says so.
        log: Called with one line per step.

    Returns:
        The contents of ``results.json``.

    Raises:
        UsageError: The baselines do not drive well enough, the folder holds another study, or a run in it is of other
            settings.
    """
    _open_folder(study)
    tables = _score(study, log)
    definition, config = study.definition, study.config
    data, test = ScenarioSet.open(study.sets.train), _test_set(study)
    # Observations and actions of all arms are the same.
    usable = usable_steps(study.train_config(definition.baselines[0], 0), data)
    for name in definition.planners:
        if not study.evaluation(name).is_dir():
            log(f"evaluating {name} on the test set")
            run_evaluation(EvaluationConfig(name), make_planner(name), test, study.evaluation(name))
    jobs = [Job(study, arm, seed, usable) for seed in range(config.seeds) for arm in config.arms]
    _train_and_evaluate([job for job in jobs if job.arm in definition.baselines], cores, log)
    baseline_conditions, strata = _conditions(study, definition.baselines), _strata(study, test)
    in_first_group = [claim for claim in study.claims if claim.group == next(iter(definition.groups))]
    first, second = (_episodes(study, name) for name in definition.baselines[:2])
    smallest = detectable(first, second, strata, definition.metrics, max(len(in_first_group), 1))
    for condition in baseline_conditions:
        log(str(condition))
    log("smallest detectable difference: " + ", ".join(f"{name} {x:.3f}" for name, x in smallest.items()))
    if not all(condition.met for condition in baseline_conditions) and not anyway:
        raise UsageError(
            "the baseline does not drive well enough for a comparison",
            file=study.folder,
            cure="train longer or with other settings in another --out, or pass --anyway",
        )
    _train_and_evaluate(jobs, cores, log)
    results = _results(study, test, strata, tables, usable) | {
        "conditions": [asdict(condition) for condition in _conditions(study, config.arms)],
        "detectable": smallest,
    }
    write_json(study.results, results)
    _write_pages(study, data, results, tables)
    log(f"wrote {study.folder / 'report.html'}")
    return results


def _write_pages(
    study: Study, data: ScenarioSet, results: Mapping[str, Any], tables: Mapping[str, ScoreTable]
) -> None:
    """Write the report, and the player of the most critical scenarios."""
    expert = score_steps(data, ExpertActions())
    actions = expert["action"][expert["known"]]
    write_report(study.definition, results, tables, actions, study.folder / "report.html")
    tops = {
        row: tables[name]
        for name in _PLAYER_METHODS
        if name in tables
        for row in top_rows(tables[name], _PLAYER_TOP)
    }
    write_player(
        [data[row] for row in tops],
        study.folder / "critical.html",
        overwrite=True,
        title="most critical drives",
        details=[criticality_html(table, row) for row, table in tops.items()],
    )


def _open_folder(study: Study) -> None:
    """Create the folder of a study, or check that it holds this one."""
    sets = study.sets
    data = [ScenarioSet.open(path) for path in (sets.train, sets.validation, *sets.test)]
    check_lengths(*data)
    definition = hashlib.sha256(settings.dump(study.definition).encode()).hexdigest()
    if not study.folder.exists() or not any(study.folder.iterdir()):
        unlabelled_arms = [name for name, arm in study.arms.items() if arm.method != "oracle"]
        if len(unlabelled_arms) < len(study.arms) and not event_kinds(data[0]).any():
            raise UsageError(
                "has no labelled events, which the oracle and its control need",
                file=sets.train,
                cure=f"pass --arms [{','.join(unlabelled_arms)}]",
            )
        RunFolder.create(study.folder, study.config, data, kind="study", definition=definition)
        return
    folder = RunFolder.open(study.folder)
    sources = [entry["hash"] for entry in folder.info.get("data", [])]
    if folder.config(StudyConfig) != study.config or sources != [part.hash for part in data]:
        raise UsageError(
            "contains a study with other settings, or of other scenarios",
            file=study.folder,
            cure="choose another name",
        )
    # Claims are fixed before the evaluation. Studies of earlier versions do not name their definition.
    if folder.info.get("definition", definition) != definition:
        raise UsageError(
            "contains a study with other arms or claims", file=study.folder, cure="choose another name"
        )


def _score(study: Study, log: Log) -> dict[str, ScoreTable]:
    """Return the scores of the training set by every method of the arms, read if they exist."""
    data, tables = ScenarioSet.open(study.sets.train), {}
    for method in dict.fromkeys(arm.method for arm in study.arms.values()):
        file = study.scores(method)
        config = study.config.ensemble if method == "ensemble" else None
        if not file.is_file():
            log(f"scoring by {method}")
            write_scores(curate(method, Request(data, config=config)), file)
        tables[method] = read_scores(file, data)
        check_current(tables[method], config, file)
    return tables


def _test_set(study: Study) -> ScenarioSet:
    """Return the test scenarios as one set; if events are labelled, half of them have one."""
    if not study.test.is_dir():
        parts = [ScenarioSet.open(path) for path in study.sets.test]
        rows = [(part, row) for part in parts for row in range(len(part))]
        with_event = np.concatenate([event_kinds(part) for part in parts]) > 0
        if with_event.any() and not with_event.all():
            count = min(with_event.sum(), (~with_event).sum())
            selected = [np.flatnonzero(stratum)[:count] for stratum in (with_event, ~with_event)]
            rows = [rows[index] for index in np.sort(np.concatenate(selected))]
        source = {"command": "study", "sets": [part.hash for part in parts]}
        with ScenarioWriter(study.test, parts[0].capacity, source) as writer:
            for part, row in rows:
                writer.add(part[row])
    return ScenarioSet.open(study.test)


def _strata(study: Study, test: ScenarioSet) -> Strata:
    """Return the rare test scenarios (labelled, else most critical), and their share in ordinary traffic."""
    recordings = recordings_of(test.entries)
    rare = event_kinds(test) > 0
    labelled = bool(rare.any())
    if not labelled:
        scores = curate("kinematic", Request(test)).scenarios
        rare = scores >= np.quantile(scores, 1.0 - study.config.rare)
    ordinary = event_kinds(ScenarioSet.open(study.sets.test[0])) > 0
    if labelled and not ordinary.any():
        raise UsageError(
            "has no labelled event, so that their share of ordinary traffic is unknown",
            file=study.sets.test[0],
            cure="name a test set with events as frequent as on the road first",
        )
    return Strata(recordings, rare, float(ordinary.mean()) if labelled else None)


def _train_and_evaluate(jobs: Sequence[Job], cores: int | None, log: Log) -> None:
    """Run the unfinished jobs, each on one core."""
    pending = [job for job in jobs if not _is_finished(job)]
    for number, (job, seconds) in enumerate(one_core_each(_run_job, pending, cores), start=1):
        log(
            f"trained and evaluated {job.arm}, seed {job.seed} in {seconds:.0f} s ({number} of {len(pending)})"
        )


def _is_finished(job: Job) -> bool:
    """Return whether an arm is trained and evaluated.

    Raises:
        UsageError: Its run has other settings, or its evaluation is of a former run.
    """
    run = job.study.run(job.arm, job.seed)
    if not (run / "config.yaml").is_file():
        return False
    folder = RunFolder.open(run)
    evaluations = [job.study.evaluation(name, job.seed) for name in job.study.evaluations(job.arm)]
    expected = hashes(ScenarioSet.open(job.study.sets.validation), job.weighted().weights)
    if folder.config(TrainConfig) != job.study.train_config(job.arm, job.seed) or any(
        folder.info.get(name) != value for name, value in expected.items()
    ):
        raise UsageError(
            "was trained with other settings or weights than those of this study", file=run,
            cure=f"remove it and {' and '.join(map(str, evaluations))}; all are made again",
        )  # fmt: skip
    return is_evaluated(job.study, job.arm, job.seed)


def is_evaluated(study: Study, arm: str, seed: int) -> bool:
    """Return whether an arm has all its evaluations.

    Raises:
        UsageError: One of them is older than the run.
    """
    evaluations = [study.evaluation(name, seed) for name in study.evaluations(arm)]
    for folder in filter(lambda folder: folder.is_dir(), evaluations):
        evaluated, trained = (
            datetime.fromisoformat(RunFolder.open(path).info["started"])
            for path in (folder, study.run(arm, seed))
        )
        if evaluated < trained:
            raise UsageError(
                "is older than the run that it evaluates", file=folder, cure="remove it; it is made again"
            )
    return all(folder.is_dir() for folder in evaluations)


def _run_job(job: Job) -> float:
    """Train and evaluate an arm; return the elapsed seconds."""
    started, study = time.perf_counter(), job.study
    config, run = study.train_config(job.arm, job.seed), study.run(job.arm, job.seed)
    steps = Checkpoints(run / "checkpoints").steps()
    if config.iterations * config.algorithm.steps_per_iteration not in steps:
        _check_not_evaluated(job, steps)
        validation = ScenarioSet.open(study.sets.validation)
        train(config, job.weighted(), run, validation=validation, resume=bool(steps), overwrite=not steps)
    test = ScenarioSet.open(study.test)
    bank = ScenarioBank.from_scenarios([test[0]])
    for name in study.evaluations(job.arm):
        folder = study.evaluation(name, job.seed)
        if not folder.is_dir():
            step = None if name == job.arm else _best_step(job)
            planner, task = load_policy(run, bank, step=step)
            planner_name = str(run) if step is None else f"{run}@{step}"
            run_evaluation(EvaluationConfig(planner_name, task=task), planner, test, folder)
    return time.perf_counter() - started


def _check_not_evaluated(job: Job, steps: Sequence[int]) -> None:
    """Raise UsageError if an evaluated run has lost its checkpoints: training again would mix two training runs."""
    names = job.study.evaluations(job.arm)
    evaluated = [folder for name in names if (folder := job.study.evaluation(name, job.seed)).is_dir()]
    if not steps and evaluated:
        run = job.study.run(job.arm, job.seed)
        raise UsageError(
            "has no checkpoints, but evaluations",
            file=run,
            cure=f"remove {' and '.join(map(str, evaluated))}",
        )


def _best_step(job: Job) -> int:
    """Return the step of the validation at which ``checkpoints_by`` is largest.

    Raises:
        UsageError: The training never logged it at a validation.
    """
    metric, file = job.study.definition.checkpoints_by, job.study.run(job.arm, job.seed) / "metrics.jsonl"
    rows = [row for row in read_rows(file) if _PROGRESS in row and row.get(metric) is not None]
    if not rows:
        raise UsageError(
            f"has no {metric!r} at a validation", file=file, cure="choose another checkpoints_by"
        )
    return int(max(rows, key=lambda row: row[metric])["step"])


def _conditions(study: Study, arms: Sequence[str]) -> list[Condition]:
    config = study.config
    return [Condition.of(arm, _validations(study, arm), config.progress, config.flat) for arm in arms]


def _validations(study: Study, arm: str) -> list[dict[str, list[float]]]:
    """Return ``score``, ``progress`` and, if logged, ``rule`` (``checkpoints_by``) at each seed's validations."""
    metric, curves = study.definition.checkpoints_by, []
    for seed in range(study.config.seeds):
        rows = [row for row in read_rows(study.run(arm, seed) / "metrics.jsonl") if _PROGRESS in row]
        curves.append(
            {
                "score": [_validation_score(row) for row in rows],
                "progress": [row[_PROGRESS] for row in rows],
                "rule": [row[metric] for row in rows if row.get(metric) is not None],
            }
        )
    return curves


def _validation_score(row: Mapping[str, float]) -> float:
    ranked = rank("score", row)
    assert ranked is not None
    return ranked[0]


def _episodes(study: Study, name: str) -> Episodes:
    """Return an arm's values by metric, one row per seed, in the order of the test set."""
    tables = [EpisodeTable.read(study.evaluation(name, seed)) for seed in range(study.config.seeds)]
    return {metric: np.stack([table.metrics[metric] for table in tables]) for metric in tables[0].metrics}


def _results(
    study: Study, test: ScenarioSet, strata: Strata, tables: Mapping[str, ScoreTable],
    usable: Bool[np.ndarray, "N T"],
) -> dict[str, Any]:  # fmt: skip
    definition, metrics, data = study.definition, study.definition.metrics, ScenarioSet.open(study.sets.train)
    episodes = {}
    for name in definition.planners:
        table = EpisodeTable.read(study.evaluation(name))
        episodes[name] = {metric: table.metrics[metric][None] for metric in metrics}
    episodes |= {arm: _episodes(study, arm) for arm in study.arms}
    baseline = definition.baselines[0]
    return {
        "about": {
            "seeds": study.config.seeds,
            "train": len(data),
            "test": len(test),
            "rare": int(strata.rare.sum()),
            "labelled": strata.share is not None,
            "share": strata.share,
        },
        "claims": [result.plain() for result in decide_claims(study.claims, episodes, strata)],
        "rates": {name: rates(values, strata, metrics) for name, values in episodes.items()},
        "draws": {
            name: asdict(
                draw_statistics(
                    arm.weighted(data, tables.__getitem__, study.config.weights, usable).weights, usable
                )
            )
            for name, arm in study.arms.items()
        },
        "rankings": rankings(tables, recordings_of(data.entries)),
        "rule_cost": rule_cost(_episodes(study, study.rival), episodes[baseline], strata, metrics),
        "validations": _validations(study, baseline),
    }
