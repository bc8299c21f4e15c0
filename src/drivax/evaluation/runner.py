"""Evaluation of a planner over all scenarios of a set, in batches, none dropped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from drivax.errors import DrivaxError, UsageError
from drivax.evaluation.results import Results
from drivax.evaluation.rollout import Episodes, drive, judging
from drivax.metrics.catalogue import METRICS
from drivax.metrics.selection import catalogue
from drivax.planners.planner import Planner
from drivax.scenario.bank import AGENT_VALID, ScenarioBank
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.catalogue import prepared
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart, Start
from drivax.simulator.traffic import LogTraffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task

#: Scenarios that run side by side; the last batch is filled up and the surplus thrown away.
BATCH = 64


def evaluate(
    planner: Planner,
    bank: ScenarioBank,
    scenarios: Sequence[Mapping[str, str]],
    *,
    task: Task | None = None,
    traffic: Traffic | None = None,
    start_step: int = CURRENT_STEP,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """Drives every scenario of a bank to the end of its log and measures it.

    Args:
        planner: The driver.
        bank: The scenarios.
        scenarios: ``dataset``, ``scenario_id`` and ``segment`` of every row of the bank.
        task: Action space and observation that the planner was made for; the default one otherwise.
        traffic: How the others move; they replay the log by default. What it needs is precomputed in the bank.
        start_step: Step of the log at which to begin.
        seed: Every scenario's key is ``fold_in(key(seed), row)``, so batching never changes a result.
        progress: Called with (done, total) after every batch.

    Raises:
        UsageError: If the table and the bank disagree, or the start step leaves no action.
        DrivaxError: If the planner produced numbers that are not finite.
    """
    simulator = Simulator(task or Task(), traffic or LogTraffic())
    return evaluate_in(
        simulator, planner, bank, scenarios, start_step=start_step, seed=seed, progress=progress
    )


def evaluate_in(
    simulator: Simulator,
    planner: Planner,
    bank: ScenarioBank,
    scenarios: Sequence[Mapping[str, str]],
    *,
    start_step: int = CURRENT_STEP,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Results:
    """:func:`evaluate` in a simulator of your own, whose starts may be noisy; its task is judged to the end of the log.

    A noisy start is drawn from the scenario's key, so every planner has the same ones under one seed.

    Raises:
        UsageError: As :func:`evaluate`; or a planner that replays the log is to begin elsewhere.
        DrivaxError: As :func:`evaluate`.
    """
    if not isinstance(simulator.task, Task):
        raise UsageError(f"{type(simulator.task).__name__} has no metrics", cure="use drivax.tasks.task.Task")
    task = judging(simulator.task)
    simulator = replace(simulator, task=task)
    bank = prepared(simulator.traffic, bank)
    _refuse_misfits(planner, (task, simulator.start), bank, scenarios, start_step)
    root = jax.random.key(seed)
    parts: list[Episodes] = []
    for first in range(0, len(bank), BATCH):
        rows = np.arange(first, min(first + BATCH, len(bank)))
        # A short last batch repeats its last scenario, so that one compilation serves all.
        size = BATCH if len(bank) > BATCH else len(rows)
        index = jnp.asarray(np.pad(rows, (0, size - len(rows)), mode="edge"), jnp.int32)
        keys = jax.vmap(lambda row: jax.random.fold_in(root, row))(index)
        episodes = drive(simulator, planner, bank, index, keys, start_step)
        kept = len(rows)
        parts.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], episodes))
        if progress is not None:
            progress(int(rows[-1]) + 1, len(bank))
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    _refuse_nan(planner, whole, scenarios)
    return Results(
        planner=planner.name,
        traffic=simulator.traffic.name,
        seed=seed,
        scenarios=scenarios,
        metrics={name: np.where(v.defined, v.value, np.nan) for name, v in whole.metrics.items()},
        events=whole.events,
        motion=whole.motion,
        start=start_step,
        offroad_steps=whole.offroad_steps,
        own={name: metric for name, metric in catalogue(task.metrics).items() if name not in METRICS},
    )


def _refuse_misfits(
    planner: Planner,
    driven: tuple[Task, Start],
    bank: ScenarioBank,
    scenarios: Sequence[Mapping[str, str]],
    start_step: int,
) -> None:
    task, start = driven
    if len(scenarios) != len(bank):
        raise UsageError(f"{len(scenarios)} scenario names for a bank of {len(bank)}")
    if not 0 <= start_step < bank.steps - 1:
        raise UsageError(f"start step {start_step} leaves no action", cure=f"use 0 to {bank.steps - 2}")
    if getattr(planner, "actions", task.actions) != task.actions:
        raise UsageError(
            f"planner {planner.name} acts in another action space than the task", cure="use the task's"
        )
    if planner.replays and start != LogStart():
        raise UsageError(
            f"planner {planner.name} replays the log and cannot begin elsewhere", cure="use expert_actions"
        )
    absent = np.flatnonzero(np.asarray(bank.agents[:, start_step, 0, AGENT_VALID]) <= 0)
    if absent.size:
        name = scenarios[int(absent[0])]["scenario_id"]
        raise UsageError(
            f"ego is not in the log at step {start_step}", record=name, cure="begin at another step"
        )


def _refuse_nan(planner: Planner, episodes: Episodes, scenarios: Sequence[Mapping[str, str]]) -> None:
    broken = np.flatnonzero(~np.isfinite(episodes.motion).all(axis=(1, 2)))
    if broken.size:
        raise DrivaxError(
            f"planner {planner.name} produced numbers that are not finite in {broken.size} scenarios",
            record=scenarios[int(broken[0])]["scenario_id"],
            cure="check its outputs there",
        )
