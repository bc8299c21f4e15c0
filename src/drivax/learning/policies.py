"""Trained policies as planners: of a run, or packed into a folder of a few files, as those of the zoo are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.planners.planner import Planner
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints, pack, unpack
from drivax.tracking.run_folder import RunFolder, seed_folders, trained_on
from drivax.tracking.zoo import policy_folder

#: What a packed policy has in the place of checkpoints.
PACKED = "policy.npz"
#: What ``run.json`` says of a training that a packed policy passes on: nothing of the place where it ran.
_PROVENANCE = ("command", "started", "versions", "git", "validation", "step")
#: Parameters do not depend on what the others did or how episodes began, and what did may no longer be there.
_APART = ("--traffic", "log", "--start.kind", "log_start")


def open_policy(run: str | Path) -> tuple[RunFolder, TrainConfig]:
    """The folder of a trained policy, and its configuration with the others and the starts as logged.

    Args:
        run: Run folder of ``drivax train``, folder of :func:`pack_policy`, or ``zoo:NAME``.

    Raises:
        UsageError: If the folder holds several agents, or the zoo has no such policy.
        DataError: If the folder is no training run.
    """
    folder = RunFolder.open(policy_folder(run))
    if folder.info.get("kind") == "seeds":
        inside = seed_folders(folder.path)
        raise UsageError(
            f"holds {len(inside)} agents", file=folder.path, cure=f"name one of them, as {inside[0]}"
        )
    return folder, folder.config(TrainConfig, _APART)


def load_policy(
    run: str | Path, bank: ScenarioBank, *, step: int | None = None, samples: bool = False
) -> tuple[Planner, Task]:
    """A trained policy, and the task that it was trained for.

    Args:
        run: Run folder of ``drivax train``, folder of :func:`pack_policy`, or ``zoo:NAME``.
        bank: Any bank; only the shapes of its observations are looked at.
        step: Which checkpoint, which the planner's name then tells; None: the best by validation score, or the newest
            without one.
        samples: Whether to act by a sample instead of the mode.

    Raises:
        UsageError: As :func:`open_policy`, or a packed policy is asked for a step.
        DataError: If the folder is no training run, or what it holds of the policy is missing or damaged.
    """
    folder, config = open_policy(run)
    learner = config.algorithm.build(config.environment(), bank, config.iterations)
    template = jax.eval_shape(lambda key: learner.init(bank, key).parameters, jax.random.key(0))

    def planner(parameters: Any) -> Planner:
        return learner.planner(
            parameters, folder.path.name if step is None else f"{folder.path.name}@{step}", samples
        )

    packed = folder.path / PACKED
    if packed.is_file():
        if step is not None:
            raise UsageError("is packed and has no steps", file=folder.path, cure=f"leave out @{step}")
        return unpack(packed, jax.eval_shape(planner, template)), config.task
    checkpoints = Checkpoints(folder.checkpoints)
    chosen = checkpoints.best() if step is None else step
    return planner(checkpoints.restore(template, chosen, part=".parameters")), config.task


def pack_policy(
    run: str | Path,
    out: str | Path,
    bank: ScenarioBank,
    notes: Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
) -> RunFolder:
    """Writes the policy of a run without all that only learning needs, to be copied, shipped and loaded as the run is.

    The folder holds ``policy.npz`` (what drives), the configuration, and where the policy comes from: command,
    versions, commit and data sets by hash; no path of the machine.

    Args:
        run: Run folder of ``drivax train``; its best policy is packed, or the newest without a validation.
        out: Folder to write; its name is the policy's.
        bank: Any bank; only the shapes of its observations are looked at.
        notes: More for ``run.json``, plain JSON values: what was measured.
        overwrite: Replace ``out`` if it is a run folder.

    Raises:
        UsageError: As :func:`load_policy`, or ``out`` exists.
        DataError: As :func:`load_policy`.
    """
    folder, _ = open_policy(run)
    checkpoints = Checkpoints(folder.checkpoints)
    step = checkpoints.best() or max(checkpoints.steps(), default=None)
    planner, _ = load_policy(run, bank, step=step)
    about = {name: folder.info.get(name) for name in _PROVENANCE}
    data = [{name: entry[name] for name in ("hash", "scenarios")} for entry in trained_on(folder.info)]
    about |= {"kind": "policy", "data": data, "machine": None, **(notes or {})}
    if step is not None:
        about["step"] = step
    config = replace(folder.config(TrainConfig), begin_from=None)
    packed = RunFolder.create(out, config, overwrite=overwrite).note(**about)
    pack(packed.path / PACKED, planner)
    return packed
