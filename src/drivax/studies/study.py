"""The study runner: score, train, evaluate, test the claims, write the report.

Arms differ in their preset and in how they draw logged steps. Each arm is trained with several seeds, by the budget of
its preset unless ``total_steps`` is set, and evaluated on one test set. Claims compare arms scenario by scenario. An
interrupted study resumes without repeating finished jobs.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from drivax import settings
from drivax.curation.logged import score_steps
from drivax.curation.methods import ORACLES, Request, check_current, curate, event_kinds
from drivax.curation.rarity import ExpertActions
from drivax.curation.scores import ScoreTable, read_scores, top_rows, write_scores
from drivax.curation.weights import draw_statistics
from drivax.errors import UsageError
from drivax.escaping import show
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.runner import EvaluationConfig, run_evaluation
from drivax.files import inside, write_json
from drivax.learning.config import TrainConfig
from drivax.learning.loop import hashes, train, usable_steps
from drivax.learning.policies import load_policy
from drivax.learning.training_log import rank
from drivax.learning.training_set import TrainingSet, episodes_digest, read_episodes
from drivax.planners.catalogue import make_planner
from drivax.report.pages.viewer import criticality_html, write_player
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.select.splits import hold_out
from drivax.scenario.store import ScenarioSet, ScenarioWriter, check_lengths
from drivax.seal import allow_edited, edited_files, is_edited_allowed, seal
from drivax.stats.clusters import recordings_of
from drivax.studies.definition import Study, StudyConfig
from drivax.studies.report import PLAYER_METHODS, PLAYER_TOP, write_report
from drivax.studies.verdicts import (
    Episodes,
    Strata,
    ValidationCheck,
    compare_rankings,
    decide_claims,
    detectable_differences,
    rates,
    rates_of_groups,
    rule_cost,
)
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.workers import one_core_each

#: What a study writes into its folder, besides the files of a run folder.
_OUTPUTS = ("scores", "test", "runs", "evaluations", "results.json", "report.html", "critical.html")
_PROGRESS = "validation/progress_ratio"
Log = Callable[[str], None]


@dataclass(frozen=True)
class Job:
    """A training run of a study.

    Attributes:
        study: The study.
        arm, seed: Name of the arm, and seed of the run.
        usable: Mask of the logged steps to draw from.
        episodes: Digest of the recorded episodes; None if there are none.
        edited: Whether edited files are allowed.
    """

    study: Study
    arm: str
    seed: int
    usable: Bool[np.ndarray, "M T"]
    episodes: str | None = None
    edited: bool = False

    def weights(self, data: ScenarioSet) -> Float[np.ndarray, "M T"]:
        """Return the arm's weights of the training set."""

        def table(method: str) -> ScoreTable:
            return read_scores(self.study.scores(method), data)

        arm, config = self.study.arms[self.arm], self.study.config
        return arm.weigh(data, table, config.weights, self.usable, self.seed)


def run_study(
    study: Study, *, cores: int | None = None, anyway: bool = False, log: Log = show
) -> dict[str, Any]:
    """Run a study, or resume it.

    Args:
        study: The study.
        cores: Number of parallel training runs; None: one per core.
        anyway: Continue even if the baselines do not meet their conditions; the report says so.
        log: Called with one line per stage.

    Returns:
        The contents of ``results.json``.

    Raises:
        DataError: A set is damaged, or a name in the study's folder is a symbolic link.
        UsageError: The baselines do not drive well enough, events are not labelled where arms or strata need them, or
            the folder holds another study, runs with other settings, or evaluations of other runs.
    """
    _open_folder(study)
    tables = _score(study, log)
    definition, config = study.definition, study.config
    training, test = _training_set(study), _test_set(study)
    data = training.scenarios
    # The presets of all arms must have the same observations and actions.
    usable = usable_steps(study.train_config(definition.baselines[0], 0), training)
    for name in definition.planners:
        if study.evaluation(name).is_dir():
            _check_test_set(study, study.evaluation(name))
        else:
            log(f"evaluating {name} on the test set")
            run_evaluation(EvaluationConfig(name), make_planner(name), test, study.evaluation(name))
    shared = (usable, episodes_digest(training.episodes), is_edited_allowed())
    jobs = [Job(study, arm, seed, *shared) for seed in range(config.seeds) for arm in config.arms]
    _train_and_evaluate([job for job in jobs if job.arm in definition.baselines], cores, log)
    strata = _strata(study, test)
    differences = _check_baselines(study, strata, anyway, log)
    _train_and_evaluate(jobs, cores, log)
    results = _results(study, test, strata, tables, usable) | {
        "conditions": [asdict(check) for check in _validation_checks(study, config.arms)],
        "detectable": differences,
        "edited": edited_files(),
    }
    write_json(study.results, results)
    seal(study.folder, study.results.name)
    _write_pages(study, data, results, tables)
    log(f"wrote {study.folder / 'report.html'}")
    return results


def _training_set(study: Study) -> TrainingSet:
    """Return the training set without weights, with the recorded episodes that it learns from."""
    data, config = ScenarioSet.open(study.sets.train), study.train_config(study.definition.baselines[0], 0)
    return TrainingSet(data, episodes=read_episodes(study.sets.episodes, data, config.task))


def _check_baselines(study: Study, strata: Strata, anyway: bool, log: Log) -> dict[str, float]:
    """Log the checks of the baselines, which must be met unless ``anyway``; return smallest detectable differences."""
    definition, checks = study.definition, _validation_checks(study, study.definition.baselines)
    first_group = next(iter(definition.groups), None)
    claim_count = sum(claim.group == first_group for claim in study.claims)
    first, second = (_episodes(study, name) for name in definition.baselines[:2])
    differences = detectable_differences(first, second, strata, definition.metrics, max(claim_count, 1))
    for check in checks:
        log(str(check))
    log("smallest detectable difference: " + ", ".join(f"{name} {x:.3f}" for name, x in differences.items()))
    if not all(check.met for check in checks) and not anyway:
        raise UsageError(
            "a baseline does not drive well enough for a comparison",
            file=study.folder,
            cure="train longer or with other settings in another --out, or pass --anyway",
        )
    return differences


def _write_pages(
    study: Study, data: ScenarioSet, results: Mapping[str, Any], tables: Mapping[str, ScoreTable]
) -> None:
    """Write the report, and the player of the most critical scenarios by :data:`PLAYER_METHODS`, if any scored them.

    A scenario that several methods select has the scores of the last of them.
    """
    expert = score_steps(data, ExpertActions())
    actions = expert["action"][expert["known"]]
    write_report(study.definition, results, tables, actions, inside(study.folder, "report.html"))
    table_of_row: dict[int, ScoreTable] = {}
    for name in PLAYER_METHODS:
        if name in tables:
            table_of_row |= dict.fromkeys(top_rows(tables[name], PLAYER_TOP), tables[name])
    if not table_of_row:
        return
    write_player(
        [data[row] for row in table_of_row],
        inside(study.folder, "critical.html"),
        overwrite=True,
        title="most critical scenarios",
        details=[criticality_html(table, row) for row, table in table_of_row.items()],
    )


def _open_folder(study: Study) -> None:
    """Create the folder of a study, or check that it contains this study."""
    data = study.sets.open()
    check_lengths(*data)
    definition = hashlib.sha256(settings.dump(study.definition).encode()).hexdigest()
    for name in _OUTPUTS:
        inside(study.folder, name)
    if study.folder.exists() and any(study.folder.iterdir()):
        _check_folder(study, data, definition)
        return
    if study.sets.validation is None and not hold_out(data[0].entries).recordings:
        problem = "all scenarios are of one recording, so none can be held out"
        raise UsageError(problem, file=study.sets.train, cure="pass --validation")
    other_arms = [name for name, arm in study.arms.items() if arm.method not in ORACLES]
    if len(other_arms) < len(study.arms) and not event_kinds(data[0]).any():
        raise UsageError(
            "has no labelled events, which the oracle arms need",
            file=study.sets.train,
            cure=f"pass --arms [{','.join(other_arms)}]",
        )
    RunFolder.create(study.folder, study.config, data, kind="study", definition=definition)


def _check_folder(study: Study, data: Sequence[ScenarioSet], definition: str) -> None:
    """Check that a folder contains this study of these sets; ``definition`` is the hash of the definition."""
    folder = RunFolder.open(study.folder)
    sources = [entry["hash"] for entry in folder.info.get("data", [])]
    config = folder.config(StudyConfig, trust=settings.modules_of(study.config))
    if config != study.config or sources != [scenarios.hash for scenarios in data]:
        raise UsageError(
            "contains a study with other settings or scenarios",
            file=study.folder,
            cure="choose another --out",
        )
    # Claims are fixed before the evaluation. Studies of earlier versions do not name their definition.
    if folder.info.get("definition", definition) != definition:
        raise UsageError(
            "contains a study with another definition, or of another version of drivax",
            file=study.folder,
            cure="choose another --out",
        )


def _score(study: Study, log: Log) -> dict[str, ScoreTable]:
    """Return the score tables of the training set by method; compute those that have no file."""
    data, tables = ScenarioSet.open(study.sets.train), {}
    egos = study.train_config(study.definition.baselines[0], 0).egos
    for method in dict.fromkeys(arm.method for arm in study.arms.values()):
        file = study.scores(method)
        config = study.config.ensemble if method == "ensemble" else None
        if not file.is_file():
            log(f"scoring by {method}")
            write_scores(curate(method, Request(data, config=config, egos=egos)), file)
        tables[method] = read_scores(file, data)
        check_current(tables[method], config, file)
    return tables


def _test_set(study: Study) -> ScenarioSet:
    """Return the test scenarios as one set."""
    if not study.test.is_dir():
        test_sets = [ScenarioSet.open(path) for path in study.sets.test]
        source = {"command": "study", "sets": [scenarios.hash for scenarios in test_sets]}
        with ScenarioWriter(study.test, test_sets[0].capacity, source) as writer:
            for scenarios in test_sets:
                for scenario in scenarios:
                    writer.add(scenario)
    return ScenarioSet.open(study.test)


def _strata(study: Study, test: ScenarioSet) -> Strata:
    """Return the strata of the test set; in a set without labels the most critical scenarios are rare."""
    recordings = recordings_of(test.entries)
    rare = event_kinds(test) > 0
    has_labels = bool(rare.any())
    if not has_labels:
        scores = curate("kinematic", Request(test)).scenarios
        rare = scores >= np.quantile(scores, 1.0 - study.config.rare)
    ordinary = event_kinds(ScenarioSet.open(study.sets.test[0])) > 0
    if has_labels and not ordinary.any():
        raise UsageError(
            "has no labelled event: the share of events in ordinary traffic is unknown",
            file=study.sets.test[0],
            cure="put a test set with the frequency of ordinary traffic first",
        )
    return Strata(recordings, rare, float(ordinary.mean()) if has_labels else None)


def event_groups(entries: Sequence[Mapping[str, Any]]) -> dict[str, Bool[np.ndarray, " scenario"]]:
    """Return masks of the scenarios with each kind of event, and with a severity below or at least the median."""
    kinds = np.array([entry["tags"].get("event", "") for entry in entries])
    severity_mps2 = np.array([float(entry["tags"].get("severity_mps2", "nan")) for entry in entries])
    groups = {kind: kinds == kind for kind in sorted({*kinds.tolist()} - {""})}
    if groups:
        median_mps2 = float(np.nanmedian(severity_mps2))
        groups |= {
            f"below {median_mps2:g} m/s2": severity_mps2 < median_mps2,
            f"from {median_mps2:g} m/s2": severity_mps2 >= median_mps2,
        }
    return groups


def _train_and_evaluate(jobs: Sequence[Job], cores: int | None, log: Log) -> None:
    """Run the unfinished jobs, each on one core."""
    pending = [job for job in jobs if not _is_finished(job)]
    for number, (job, seconds) in enumerate(one_core_each(_run_job, pending, cores), start=1):
        count = f"{number} of {len(pending)}"
        log(f"trained and evaluated {job.arm}, seed {job.seed} in {seconds:.0f} s ({count})")


def _is_finished(job: Job) -> bool:
    """Return whether an arm is trained and evaluated.

    Raises:
        UsageError: The run has other settings or weights than the study, or is newer than an evaluation.
    """
    run = job.study.run(job.arm, job.seed)
    if not (run / "config.yaml").is_file():
        return False
    folder = RunFolder.open(run)
    data, config = ScenarioSet.open(job.study.sets.train), job.study.train_config(job.arm, job.seed)
    validation = _validation(job.study)
    validation = hold_out(data.entries) if isinstance(validation, str) else validation
    job_hashes = hashes(validation, job.weights(data)) | {"recorded_episodes": job.episodes}
    if folder.config(TrainConfig, trust=settings.modules_of(config)) != config or any(
        folder.info.get(name) != value for name, value in job_hashes.items()
    ):
        evaluations = " and ".join(map(str, _evaluation_folders(job.study, job.arm, job.seed)))
        raise UsageError(
            "was trained with other settings, weights or episodes than those of this study",
            file=run,
            cure=f"remove it and {evaluations}, and run the study again",
        )
    return is_evaluated(job.study, job.arm, job.seed)


def _evaluation_folders(study: Study, arm: str, seed: int) -> list[Path]:
    return [study.evaluation(name, seed) for name in study.evaluations(arm)]


def is_evaluated(study: Study, arm: str, seed: int) -> bool:
    """Return whether an arm has all its evaluations.

    Raises:
        UsageError: An evaluation is older than the run, or of another test set.
    """
    folders = _evaluation_folders(study, arm, seed)
    existing = [folder for folder in folders if folder.is_dir()]
    for folder in existing:
        _check_test_set(study, folder)
        if _start_time(folder) < _start_time(study.run(arm, seed)):
            raise UsageError(
                "is older than the run that it evaluates",
                file=folder,
                cure="remove it, and run the study again",
            )
    return len(existing) == len(folders)


def _check_test_set(study: Study, folder: Path) -> None:
    """Check that an evaluation is of the study's test set, if that exists."""
    if study.test.is_dir():
        tested = RunFolder.open(folder).info["data"][0]["hash"]
        if tested != study.test_hash:
            raise UsageError("is of another test set", file=folder, cure="remove it, and run the study again")


def _start_time(run: Path) -> datetime:
    return datetime.fromisoformat(RunFolder.open(run).info["started"])


def _run_job(job: Job) -> float:
    """Train and evaluate an arm in a process of its own; return the elapsed seconds."""
    with allow_edited(job.edited):
        return _train_and_evaluate_arm(job)


def _train_and_evaluate_arm(job: Job) -> float:
    start, study = time.perf_counter(), job.study
    config, run = study.train_config(job.arm, job.seed), study.run(job.arm, job.seed)
    steps = Checkpoints(inside(run, "checkpoints")).steps()
    _check_not_evaluated(job, steps)
    training = _training_set(study)
    training = replace(training, weights=job.weights(training.scenarios))
    # If training is finished, this only deletes what an interruption left.
    train(config, training, run, validation=_validation(study), resume=bool(steps), overwrite=not steps)
    test = ScenarioSet.open(study.test)
    bank = ScenarioBank.from_scenarios([test[0]])
    for name, limiter in study.evaluations(job.arm).items():
        folder = study.evaluation(name, job.seed)
        if not folder.is_dir():
            step = _best_step(job) if name == study.rule_evaluation else None
            planner, task = load_policy(run, bank, step=step, trust=settings.modules_of(config))
            planner_name = str(run) if step is None else f"{run}@{step}"
            run_evaluation(EvaluationConfig(planner_name, task=task, limiter=limiter), planner, test, folder)
    return time.perf_counter() - start


def _validation(study: Study) -> ScenarioSet | Literal["held_out"]:
    """Return the validation set; without one, recordings of the training set are held out."""
    path = study.sets.validation
    return "held_out" if path is None else ScenarioSet.open(path)


def _check_not_evaluated(job: Job, steps: Sequence[int]) -> None:
    """Check that a run without checkpoints has no evaluations: they would be of another training run."""
    folders = _evaluation_folders(job.study, job.arm, job.seed)
    evaluations = [str(folder) for folder in folders if folder.is_dir()]
    if not steps and evaluations:
        run = job.study.run(job.arm, job.seed)
        raise UsageError(
            "has evaluations, but no checkpoints", file=run, cure=f"remove {' and '.join(evaluations)}"
        )


def _best_step(job: Job) -> int:
    """Return the step of the validation at which ``checkpoints_by`` is largest."""
    metric, run = job.study.definition.checkpoints_by, RunFolder(job.study.run(job.arm, job.seed), {})
    rows = (row for row in run.metric_rows() if _PROGRESS in row and row.get(metric) is not None)
    best = max(rows, key=lambda row: row[metric], default=None)
    if best is None:
        raise UsageError(
            f"has no {metric!r} at a validation", file=run.metrics, cure="choose another checkpoints_by"
        )
    return int(best["step"])


def _validation_checks(study: Study, arms: Sequence[str]) -> list[ValidationCheck]:
    """Return the validation checks of trained arms."""
    config = study.config
    return [ValidationCheck.of(arm, _validations(study, arm), config.progress, config.flat) for arm in arms]


def _validations(study: Study, arm: str) -> list[dict[str, list[Any]]]:
    """Return ``score``, ``progress`` and ``rule`` (``checkpoints_by``; None if missing) at each seed's validations."""
    metric, curves = study.definition.checkpoints_by, []
    for seed in range(study.config.seeds):
        run = RunFolder(study.run(arm, seed), {})
        curve: dict[str, list[Any]] = {"score": [], "progress": [], "rule": []}
        for row in run.metric_rows():
            if _PROGRESS in row:
                curve["score"].append(_validation_score(row))
                curve["progress"].append(row[_PROGRESS])
                curve["rule"].append(row.get(metric))
        curves.append(curve)
    return curves


def _validation_score(row: Mapping[str, float]) -> float:
    """Return the score by which a training run chooses its best checkpoint."""
    ranking = rank("score", row)
    assert ranking is not None
    return ranking[0]


def _episodes(study: Study, name: str) -> Episodes:
    """Return an arm's values by metric, one row per seed, in the order of the test set."""
    tables = [EpisodeTable.read(study.evaluation(name, seed)) for seed in range(study.config.seeds)]
    return {metric: np.stack([table.metrics[metric] for table in tables]) for metric in tables[0].metrics}


def _results(
    study: Study, test: ScenarioSet, strata: Strata, tables: Mapping[str, ScoreTable],
    usable: Bool[np.ndarray, "M T"],
) -> dict[str, Any]:  # fmt: skip
    """Return the contents of ``results.json``, except ``conditions``, ``detectable`` and ``edited``."""
    definition, metrics, data = study.definition, study.definition.metrics, ScenarioSet.open(study.sets.train)
    episodes = {}
    for name in definition.planners:
        table = EpisodeTable.read(study.evaluation(name))
        episodes[name] = {metric: table.metrics[metric][None] for metric in metrics}
    episodes |= {arm: _episodes(study, arm) for arm in study.arms}
    slower = {
        arm: {share: _episodes(study, study.slower(arm, share)) for share in definition.limiters}
        for arm in study.arms
        if len(set(study.evaluations(arm).values())) > 1
    }
    baseline, groups = definition.baselines[0], event_groups(test.entries)
    tested = episodes | {
        study.slower(arm, share): values for arm in slower for share, values in slower[arm].items()
    }
    weights = {
        name: arm.weigh(data, tables.__getitem__, study.config.weights, usable)
        for name, arm in study.arms.items()
    }
    return {
        "about": {
            "seeds": study.config.seeds,
            "train": len(data),
            "test": len(test),
            "rare": int(strata.rare.sum()),
            "labelled": strata.share is not None,
            "share": strata.share,
        },
        "claims": [result.plain() for result in decide_claims(study.claims, episodes, strata, slower)],
        "rates": {name: rates(values, strata, metrics) for name, values in tested.items()},
        "events": {
            name: rates_of_groups(values, strata, groups, metrics[0]) for name, values in tested.items()
        },
        "critics": {
            arm: [
                RunFolder.open(study.run(arm, seed)).info.get("critics") for seed in range(study.config.seeds)
            ]
            for arm in study.arms
        },
        "draws": {
            name: asdict(draw_statistics(weights[name], usable, len(usable) // len(data)))
            for name in study.arms
        },
        "rankings": compare_rankings(tables, recordings_of(data.entries)),
        "rule_cost": rule_cost(_episodes(study, study.rule_evaluation), episodes[baseline], strata, metrics),
        "validations": _validations(study, baseline),
    }
