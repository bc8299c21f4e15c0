"""Sealed files: edits and accidents are seen before they change a result, and edited files leave a mark."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from drivax import settings
from drivax.cli import main
from drivax.errors import DataError
from drivax.evaluation.comparison import compare
from drivax.evaluation.episode_table import Crash, EpisodeTable, Trajectories
from drivax.evaluation.plan import ComparisonPlan
from drivax.evaluation.result_tables import planners_table, transfer_table
from drivax.evaluation.runner import EvaluationConfig
from drivax.learning.config import TrainConfig
from drivax.learning.policies import open_policy
from drivax.learning.training_log import TrainingLog
from drivax.metrics.catalogue import EVENTS
from drivax.report.pages.comparison import comparison_text
from drivax.report.pages.report import write_report
from drivax.report.runs import read_runs
from drivax.seal import SEAL, allow_edited, check_seal, edited_files, seal, unseal
from drivax.studies.definition import StudyConfig
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.run_folder import RunFolder, policy_folder, zoo

EPISODES = 12
PLAN = ComparisonPlan(primary="success", secondary=("progress_ratio",), minimum_scenarios=5, resamples=100)


def evaluation(folder: Path, planner: str, seed: int = 0) -> Path:
    """An evaluation as ``run_evaluation`` writes it, with random results and a crash."""
    rng = np.random.default_rng(seed)
    ids = tuple(f"s{number}" for number in range(EPISODES))
    recordings = tuple(f"r{number // 2}" for number in range(EPISODES))
    keys = {"planner": (planner,), "dataset": ("d",), "seed": ("0",), "traffic": ("log",)}
    info = {"planner": planner, "traffic": "log"}
    rollouts = Trajectories(
        rng.normal(size=(EPISODES, 3, 4)).astype(np.float32), rng.normal(size=(EPISODES, 2, 2)), np.zeros(EPISODES, int),
        {name: np.full(EPISODES, -1) for name in EVENTS},
    )  # fmt: skip
    table = EpisodeTable(
        None, planner, info,
        {name: values * EPISODES for name, values in keys.items()} | {"scenario_id": ids, "segment": recordings},
        {"success": rng.integers(0, 2, EPISODES).astype(float), "progress_ratio": rng.random(EPISODES)},
        (Crash("d", "s3", 17, "ValueError: no lane"),), rollouts,
    )  # fmt: skip
    RunFolder.create(folder, EvaluationConfig(planner), kind="evaluation", **info)
    table.write(folder)
    return folder


def training(folder: Path) -> Path:
    """A finished training with one checkpoint, as the training loop leaves it."""
    run = RunFolder.create(folder, TrainConfig(), kind="training")
    with TrainingLog(run, "score", keep=2, patience=0) as log:
        log.start(None)
        for step in (100, 200):
            log.write(step, {"loss": 1 / step, "validation/vmax_score": step / 300})
            log.checkpoints.save(step, {"w": np.arange(3.0)}, step / 300)
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sealed")
    study = RunFolder.create(root / "study", StudyConfig(), kind="study", definition="c0de").path
    (study / "results.json").write_text('{"claims": []}')
    seal(study, "results.json")
    policy = shutil.copytree(policy_folder("zoo:ppo"), root / "policy")
    other = evaluation(root / "b", "other", 1)
    evaluations = {"evaluation": evaluation(root / "a", "ours"), "other": other}
    return evaluations | {"training": training(root / "training"), "study": study, "policy": policy}


def results(kind: str, folder: Path, other: Path) -> object:
    """What drivax prints, draws or decides with the files of a folder."""
    if kind == "evaluation":
        tables, _ = read_runs([other, folder])
        comparison = compare(PLAN, (EpisodeTable.read(folder),), (EpisodeTable.read(other),))
        text = planners_table(tables, ["success", "progress_ratio"]).html()
        transfer = transfer_table(tables, "success").csv()
        crashes = [table.crashes for table in tables]
        return comparison_text(comparison), text, transfer, crashes, tables[1].settings, tables[1].info
    if kind == "training":
        (curves,) = read_runs([folder])[1]
        checkpoints, run = Checkpoints(folder / "checkpoints"), RunFolder.open(folder)
        values = {name: points.tolist() for name, points in curves.curves.items()}
        return values, curves.info, run.config(TrainConfig), checkpoints.best(), checkpoints.about(200)
    if kind == "policy":
        run, config = open_policy(folder)
        return run.info, config
    run = RunFolder.open(folder)
    check_seal(folder / "results.json")
    return run.info, run.config(StudyConfig), (folder / "results.json").read_text()


def outcome(kind: str, folder: Path, other: Path) -> tuple[object, str]:
    """Return the results, and the line of a DataError instead of them."""
    try:
        return results(kind, folder, other), ""
    except DataError as error:
        return None, str(error)


def bytes_by_class(content: bytes) -> dict[str, list[int]]:
    """Positions of the bytes of a text by class."""
    classes: dict[str, list[int]] = {}
    for position, byte in enumerate(content):
        letter = chr(byte)
        kind = (
            "digit"
            if letter.isdigit()
            else "letter"
            if letter.isalpha()
            else "space"
            if letter.isspace()
            else letter
        )
        classes.setdefault(kind if len(kind) > 1 else "punctuation", []).append(position)
    return classes


def text_files(folder: Path) -> list[Path]:
    suffixes = (".csv", ".json", ".jsonl", ".yaml")
    return sorted(
        file for file in folder.rglob("*") if file.suffix in suffixes and "arrays" not in file.parts
    )


def test_no_flip_in_a_text_file_changes_a_result_silently(folders):
    """Every class of bytes of every text file of an evaluation, a training, a policy and a study."""
    rng, flips, seen, silent = random.Random(0), 0, 0, []
    for kind in ("evaluation", "training", "policy", "study"):
        folder, other = folders[kind], folders["other"]
        expected, problem = outcome(kind, folder, other)
        assert expected is not None, problem
        for file in text_files(folder):
            content = file.read_bytes()
            for positions in bytes_by_class(content).values():
                for position in rng.sample(positions, min(9, len(positions))):
                    flipped = bytearray(content)
                    flipped[position] ^= 1 << rng.randrange(8)
                    file.write_bytes(flipped)
                    found, line = outcome(kind, folder, other)
                    flips, seen = flips + 1, seen + bool(line)
                    if found != expected and (not line or "\n" in line):
                        silent.append((str(file), position, line))
            file.write_bytes(content)
    print(f"{flips} flips, {seen} seen, {flips - seen - len(silent)} without effect, {len(silent)} silent")
    assert flips >= 500 and seen > flips / 2 and silent == []
