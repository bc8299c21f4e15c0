"""The drives of a long-tail study: its test set, who drives it, and what is read back."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from drivax.curation.controls import event_kinds
from drivax.curation.methods import Request, curate
from drivax.errors import UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.evaluation.run_evaluation import EvaluationConfig, run_evaluation
from drivax.learning.policies import load_policy
from drivax.planners.catalogue import make_planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.stats.clusters import recordings_of
from drivax.studies.longtail_plan import (
    BY_MEAN_Q,
    DRIVES,
    REFERENCES,
    TEST,
    LongtailConfig,
    Sets,
    drive_of,
    run_of,
)
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import read_rows

#: What critics expect of the policy on held-out steps: by it the published study advises to choose checkpoints.
MEAN_Q = "validation/mean_q"
Say = Callable[[str], None]


def test_set(sets: Sets, out: Path) -> ScenarioSet:
    """The scenarios of the test, as a set of their own: half of them with an event where events are labelled."""
    path = out / TEST
    if not path.is_dir():
        parts = [ScenarioSet.open(one) for one in sets.test]
        rows = [(part, row) for part in parts for row in range(len(part))]
        with_event = np.concatenate([event_kinds(part) for part in parts]) > 0
        if with_event.any() and not with_event.all():
            most = min(with_event.sum(), (~with_event).sum())
            kinds = [np.flatnonzero(one)[:most] for one in (with_event, ~with_event)]
            rows = [rows[place] for place in np.sort(np.concatenate(kinds))]
        source = {"command": "study longtail", "sets": [part.hash for part in parts]}
        with ScenarioWriter(path, parts[0].capacity, source) as writer:
            for part, row in rows:
                writer.add(part[row])
    return ScenarioSet.open(path)


def rare_rows(config: LongtailConfig, test: ScenarioSet) -> Bool[np.ndarray, " n"]:
    """Which scenarios of the test are rare: those with an event, or the most critical ones where none are labelled."""
    labelled = event_kinds(test) > 0
    if labelled.any():
        return labelled
    scores = curate("kinematic", Request(test)).scenarios
    return scores >= np.quantile(scores, 1.0 - config.rare)


def ordinary_share(sets: Sets) -> float | None:
    """Share of scenarios with an event in ordinary traffic: in the first test set; None where nothing is labelled."""
    labelled = event_kinds(ScenarioSet.open(sets.test[0])) > 0
    return float(labelled.mean()) if labelled.any() else None


def drive_references(out: Path, test: ScenarioSet, say: Say) -> None:
    """Drives the test set with those who need no training, unless they have."""
    for name in REFERENCES:
        folder = out / DRIVES / name
        if not folder.is_dir():
            say(f"driving the test set: {name}")
            run_evaluation(EvaluationConfig(name), make_planner(name), test, folder)


def drive(out: Path, agent: str, seed: int) -> None:
    """Drives the test set with an agent, unless it has; with the baseline by other checkpoints, too."""
    test, run = ScenarioSet.open(out / TEST), run_of(out, agent, seed)
    bank = ScenarioBank.from_scenarios([test[0]])
    for name in names(agent):
        folder = drive_of(out, name, seed)
        if not folder.is_dir():
            step = step_by_mean_q(run) if name == BY_MEAN_Q else None
            planner, task = load_policy(run, bank, step=step)
            told = str(run) if step is None else f"{run}@{step}"
            run_evaluation(EvaluationConfig(told), planner, test, folder, task=task)


def has_driven(out: Path, agent: str, seed: int) -> bool:
    """Whether an agent has driven the test set.

    Raises:
        UsageError: It was trained anew since.
    """
    folders = [drive_of(out, name, seed) for name in names(agent)]
    for folder in folders:
        if folder.is_dir():
            _refuse_older(folder, run_of(out, agent, seed))
    return all(folder.is_dir() for folder in folders)


def names(agent: str) -> tuple[str, ...]:
    """What the drives of an agent are called."""
    return (agent, BY_MEAN_Q) if agent == "baseline" else (agent,)


def _refuse_older(folder: Path, run: Path) -> None:
    """Refuses a drive that is older than the run that it is said to be of.

    Raises:
        UsageError: The agent was trained anew since.
    """
    drove, began = (datetime.fromisoformat(RunFolder.open(one).info["started"]) for one in (folder, run))
    if drove < began:
        raise UsageError(
            "is older than the run that drove it", file=folder, cure="remove it; it is driven anew"
        )


def step_by_mean_q(run: Path) -> int:
    """The step of the validation at which critics expected most."""
    rows = [row for row in read_rows(run / "metrics.jsonl") if MEAN_Q in row]
    return int(max(rows, key=lambda row: row[MEAN_Q])["step"])


def driven(config: LongtailConfig, out: Path, agent: str) -> dict[str, Float[np.ndarray, "seed scenario"]]:
    """What the agents of one name did in the test, by metric, in the order of the test set."""
    tables = [EpisodeTable.read(drive_of(out, agent, seed)) for seed in range(config.seeds)]
    return {name: np.stack([table.metrics[name] for table in tables]) for name in tables[0].metrics}


def clusters(test: ScenarioSet) -> list[str]:
    """The recording of every scenario."""
    return recordings_of(test.entries)
