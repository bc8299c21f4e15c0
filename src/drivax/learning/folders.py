"""Run folders of training: one per agent; those of agents that learn side by side lie together in one."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.learning.first_state import Origin
from drivax.scenario.store import ScenarioSet
from drivax.tracking.run_folder import RunFolder, seed_folders


def facts(config: TrainConfig, validation: ScenarioSet | None, weights: np.ndarray | None) -> dict[str, Any]:
    """What ``run.json`` says of a run beside its data: :func:`hashes`, and the run that its networks come from."""
    told: dict[str, Any] = hashes(validation, weights)
    if config.begin_from is not None:
        told["networks_from"] = Origin.of(config.begin_from).notes()
    return told


def hashes(validation: ScenarioSet | None, weights: np.ndarray | None) -> dict[str, str | None]:
    """What ``run.json`` says of a run beside its data: hashes of what it is validated on, and of its weights."""
    weighed = None if weights is None else hashlib.sha256(np.asarray(weights, "<f8").tobytes()).hexdigest()
    return {"validation": None if validation is None else validation.hash, "weights": weighed}


def create_folders(
    config: TrainConfig,
    data: ScenarioSet,
    out: Path,
    seeds: tuple[int, ...],
    overwrite: bool,
    notes: Mapping[str, Any],
) -> list[RunFolder]:
    """The folder of each agent: ``out``, or for several ``out/seed-<seed>``.

    Raises:
        UsageError: ``out`` exists and ``overwrite`` is not given.
    """
    if len(seeds) == 1:
        return [RunFolder.create(out, config, [data], overwrite, kind="training", **notes)]
    RunFolder.create(out, config, [data], overwrite, kind="seeds", seeds=len(seeds), **notes)
    return [
        RunFolder.create(out / f"seed-{seed}", replace(config, seed=seed), [data], kind="training", **notes)
        for seed in seeds
    ]


def resumed_folders(
    data: ScenarioSet, validation: ScenarioSet | None, weights: np.ndarray | None, out: Path, seeds: int
) -> tuple[TrainConfig, list[RunFolder]]:
    """The configuration that a run began with, and the folder of each of its agents.

    Raises:
        UsageError: It was trained or validated on other scenarios, with other weights, or with other seeds.
    """
    folder, now = RunFolder.open(out), hashes(validation, weights)
    if folder.info.get("validation") != now["validation"]:
        raise UsageError(
            "was validated on other scenarios", file=out, cure="resume with the same --validation"
        )
    if folder.info.get("weights") != now["weights"]:
        raise UsageError("was trained with other weights", file=out, cure="resume with the same weights")
    trained_on = [entry.get("hash") for entry in folder.info.get("data", [])]
    if trained_on != [data.hash]:
        raise UsageError("was trained on other scenarios", file=out, cure="resume with the same --data")
    folders = [RunFolder.open(path) for path in seed_folders(out)]
    if seeds not in (1, len(folders)):
        raise UsageError(f"holds {len(folders)} agents, not {seeds}", file=out, cure="resume without --seeds")
    return folder.config(TrainConfig), folders
