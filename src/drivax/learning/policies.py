"""Trained policies as planners."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.planners.planner import Planner
from drivax.scenario.bank import ScenarioBank
from drivax.simulator.starts import LogStart
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.runs import RunFolder, seed_folders


def load_policy(
    run: str | Path, bank: ScenarioBank, *, step: int | None = None, samples: bool = False
) -> tuple[Planner, Task]:
    """The policy of a training run, and the task that it was trained for.

    Args:
        run: Run folder of ``drivax train``.
        bank: Any bank; only the shapes of its observations are looked at.
        step: Which checkpoint; None: the best by validation score, or the newest without one.
        samples: Whether to act by a sample instead of the mode.

    Raises:
        UsageError: If the folder holds several agents.
        DataError: If the folder is no training run, or the checkpoint is missing or damaged.
    """
    folder = RunFolder.open(run)
    if folder.info.get("kind") == "seeds":
        inside = seed_folders(folder.path)
        raise UsageError(
            f"holds {len(inside)} agents", file=folder.path, cure=f"name one of them, as {inside[0]}"
        )
    config = folder.config(TrainConfig)
    # Parameters do not depend on what the others did, and the bank may not be prepared for it.
    environment = replace(config, traffic="log", start=LogStart()).environment()
    learner = config.algorithm.build(environment, bank, config.iterations)
    checkpoints = Checkpoints(folder.checkpoints)
    template = jax.eval_shape(lambda key: learner.init(bank, key).parameters, jax.random.key(0))
    chosen = checkpoints.best() if step is None else step
    parameters = checkpoints.restore(template, chosen, part=".parameters")
    return learner.planner(parameters, folder.path.name, samples), config.task
