"""Evaluation of a planner over all scenarios of a set, none dropped.

An episode follows from planner, task, traffic, start, seed and scenario alone. Chance follows from who a scenario is
(``bank.identity``), and one program drives always as many scenarios side by side (a short batch is filled up), in banks
of the same sizes; so neither order nor company nor how many are loaded at a time changes a bit of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from drivax.errors import DataError, DrivaxError, UsageError
from drivax.evaluation.actions import action_jerk, until_crash
from drivax.evaluation.audit import scenario_names
from drivax.evaluation.memory import free_memory, scenarios_at_a_time, telling_out_of_memory
from drivax.evaluation.results import ADDED, KEYS, Crash, Results, with_crashes
from drivax.evaluation.rollout import Episodes, drive, episode_keys, judging
from drivax.metrics.catalogue import METRICS, Metric
from drivax.metrics.selection import metric_specs
from drivax.planners.functions import raised
from drivax.planners.planner import Planner
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank, Sizes, identities
from drivax.scenario.schema import CURRENT_STEP, STEPS, Flag, Scenario
from drivax.simulator.simulator import Simulator
from drivax.simulator.starts import LogStart
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import Traffic
from drivax.tasks.task import Task

#: Scenarios that a program drives side by side on a CPU, where more leave the caches and fewer cost overhead
#: (docs/log/2026-11-22-evaluation.md), and on anything else.
LANES, LANES_ELSEWHERE = 16, 256
#: No more scenarios than these are named in an error.
_TOLD = 5
Progress = Callable[[int, int], None]


def lanes() -> int:
    """How many scenarios a program drives side by side on this platform."""
    return LANES if jax.default_backend() == "cpu" else LANES_ELSEWHERE


def evaluate(
    planner: Planner,
    bank: ScenarioBank,
    scenarios: Sequence[Mapping[str, str]],
    *,
    task: Task | None = None,
    traffic: Traffic | None = None,
    start_step: int = CURRENT_STEP,
    seed: int = 0,
    progress: Progress | None = None,
) -> Results:
    """Drives every scenario of a bank to the end of its log and measures it.

    Args:
        planner: The driver.
        bank: The scenarios.
        scenarios: ``dataset``, ``scenario_id`` and ``segment`` of every row of the bank.
        task: Action space and observation that the planner was made for; the default one otherwise.
        traffic: How the others move; they replay the log by default. What it needs is precomputed in the bank.
        start_step: Step of the log at which to begin.
        seed: Every scenario's key is this one's with the scenario's identity folded in.
        progress: Called with (done, total) after every batch.

    Raises:
        UsageError: If the table and the bank disagree, or an episode cannot begin there.
        DrivaxError: If the memory does not suffice.
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
    progress: Progress | None = None,
) -> Results:
    """:func:`evaluate` in a simulator of your own, whose starts may be noisy; its task is judged to the end of the log.

    A noisy start is drawn from the scenario's key, so every planner has the same ones under one seed.

    Raises:
        UsageError: As :func:`evaluate`; or a planner that replays the log is to begin elsewhere.
        DrivaxError: As :func:`evaluate`.
    """
    if len(scenarios) != len(bank):
        raise UsageError(
            f"{len(scenarios)} scenario names for a bank of {len(bank)}", cure="name every row of the bank"
        )
    trial = _Trial.of(simulator, planner, start_step, seed, bank.steps)
    _refuse_without_future(scenarios, np.asarray(bank.flags) & Flag.NO_FUTURE != 0)
    trial.refuse_absent(scenarios, np.asarray(bank.agents[:, start_step, 0, AgentColumn.VALID]) > 0)
    with raised() as errors, telling_out_of_memory(len(bank)):
        episodes = trial.drive_all(bank, progress)
    return trial.results(episodes, scenarios, np.asarray(bank.identity), errors)


def evaluate_scenarios(
    simulator: Simulator,
    planner: Planner,
    scenarios: Sequence[Scenario],
    *,
    start_step: int = CURRENT_STEP,
    seed: int = 0,
    batch: int | None = None,
    sizes: Sizes | None = None,
    progress: Progress | None = None,
) -> Results:
    """:func:`evaluate_in` for stored scenarios, however many: as many are loaded at a time as memory allows.

    Args:
        simulator: Task, traffic and start.
        planner: The driver.
        scenarios: What is driven; all of one capacity.
        start_step: Step of the log at which to begin.
        seed: Of all chance.
        batch: How many are loaded at a time; no result depends on it.
        sizes: Of the banks; those that all of ``scenarios`` use by default. Parts of a set that are given the sizes of
            the whole are driven by the same program.
        progress: Called with (done, total).

    Raises:
        UsageError: As :func:`evaluate_in`, or ``batch`` is none.
        DataError: A scenario has no logged future.
        DrivaxError: As :func:`evaluate`.
    """
    if batch is not None and batch < 1:
        raise UsageError(f"a batch of {batch} scenarios", cure="use 1 or more")
    names = scenario_names(scenarios)
    trial = _Trial.of(simulator, planner, start_step, seed, STEPS)
    _refuse_without_future(names, [Flag.NO_FUTURE in scenario.has for scenario in scenarios])
    trial.refuse_absent(names, np.array([scenario.agent_valid[start_step, 0] for scenario in scenarios]))
    numbers = identities([(row["dataset"], row["scenario_id"]) for row in names])
    total, sizes = len(scenarios), sizes or Sizes.used(scenarios)
    one = prepare_bank(simulator.traffic, ScenarioBank.from_scenarios(scenarios[:1], trim=sizes)).nbytes
    size = min(batch or scenarios_at_a_time(one, lanes(), free_memory(jax.devices()[0])), total)
    parts: list[Episodes] = []
    with raised() as errors, telling_out_of_memory(size):
        for first in range(0, total, size):
            rows = slice(first, first + size)
            bank = ScenarioBank.from_scenarios(scenarios[rows], trim=sizes)
            bank = replace(bank, identity=jnp.asarray(numbers[rows]))
            parts.append(trial.drive_all(bank, _on(progress, first, total)))
    return trial.results(_joined(parts), names, numbers, errors)


@dataclass(frozen=True)
class _Trial:
    """What is evaluated, and how.

    Attributes:
        simulator: With a task that is judged.
        planner: The driver.
        start_step: Step of the log at which episodes begin.
        seed: Of all chance.
        metrics: What is measured.
    """

    simulator: Simulator
    planner: Planner
    start_step: int
    seed: int
    metrics: Mapping[str, Metric]

    @classmethod
    def of(cls, simulator: Simulator, planner: Planner, start_step: int, seed: int, steps: int) -> _Trial:
        """Refuses what does not go together."""
        task = simulator.task
        if not isinstance(task, Task):
            raise UsageError(f"{type(task).__name__} has no metrics", cure="use drivax.tasks.task.Task")
        if not 0 <= start_step < steps - 1:
            raise UsageError(f"start step {start_step} leaves no action", cure=f"use 0 to {steps - 2}")
        if getattr(planner, "actions", task.actions) != task.actions:
            raise UsageError(
                f"planner {planner.name} acts in another action space than the task", cure="use the task's"
            )
        if planner.replays and simulator.start != LogStart():
            raise UsageError(
                f"planner {planner.name} replays the log and cannot begin elsewhere",
                cure="use expert_actions",
            )
        judged = judging(task)
        metrics = metric_specs(judged.metrics)
        if taken := sorted({*KEYS, *ADDED} & metrics.keys()):
            raise UsageError(f"there is another column {taken[0]!r}", cure="give your metric another name")
        return cls(replace(simulator, task=judged), planner, start_step, seed, metrics)

    def refuse_absent(self, names: Sequence[Mapping[str, str]], there: Any) -> None:
        """Refuses logs that do not have ego where an episode is to begin: nobody could be judged in them."""
        absent = [row["scenario_id"] for row, present in zip(names, there, strict=True) if not present]
        if absent:
            cure = "begin at another step"
            if len(absent) <= _TOLD:
                cure += f", or leave them out: --filter 'scenario_id!={'|'.join(absent)}'"
            raise UsageError(
                f"ego is not in the log at step {self.start_step} in {len(absent)} of {len(names)} scenarios",
                record=absent[0],
                cure=cure,
            )

    def drive_all(self, bank: ScenarioBank, progress: Progress | None = None) -> Episodes:
        """The episodes of all scenarios of a bank, in its order."""
        bank, width = prepare_bank(self.simulator.traffic, bank), lanes()
        parts: list[Episodes] = []
        for first in range(0, len(bank), width):
            kept = min(width, len(bank) - first)
            rows = np.pad(np.arange(first, first + kept), (0, width - kept), mode="edge")
            some, keys = _side_by_side(bank, jnp.asarray(rows, jnp.int32), self.seed)
            place = jnp.arange(width, dtype=jnp.int32)
            found = drive(self.simulator, self.planner, some, place, keys, self.start_step)
            parts.append(jax.tree.map(lambda leaf, kept=kept: np.asarray(leaf)[:kept], found))
            if progress is not None:
                progress(first + kept, len(bank))
        return _joined(parts)

    def results(
        self,
        episodes: Episodes,
        names: Sequence[Mapping[str, str]],
        numbers: Any,
        errors: Mapping[tuple[int, int], str],
    ) -> Results:
        """The episodes as results.

        Args:
            episodes: What was driven.
            names: The scenarios.
            numbers: Their identities.
            errors: What the planner raised, by identity and step.
        """
        self._refuse_nan(episodes, names)
        found = episodes.metrics
        actions = until_crash(np.asarray(episodes.actions), np.asarray(episodes.crashed), self.start_step)
        metrics = {"action_jerk": action_jerk(actions)} | {
            name: np.where(found[name].defined, found[name].value, np.nan) for name in self.metrics
        }
        crashes = tuple(
            Crash(row, step, errors.get((int(numbers[row]), step), "action is not finite"))
            for row, step in enumerate(episodes.crashed.tolist())
            if step >= 0
        )
        return Results(
            planner=self.planner.name,
            traffic=self.simulator.traffic.name,
            seed=self.seed,
            scenarios=names,
            metrics=with_crashes(metrics, episodes.crashed >= 0),
            events={name: np.asarray(steps) for name, steps in episodes.events.items()},
            motion=np.asarray(episodes.motion),
            actions=actions,
            others=None if episodes.others is None else np.asarray(episodes.others),
            start=self.start_step,
            offroad_steps=np.asarray(episodes.offroad_steps),
            own={name: metric for name, metric in self.metrics.items() if name not in METRICS},
            crashes=crashes,
        )

    def _refuse_nan(self, episodes: Episodes, names: Sequence[Mapping[str, str]]) -> None:
        """The planner gave numbers and yet ego is nowhere: no episode, but a defect."""
        broken = np.flatnonzero(~np.isfinite(episodes.motion).all(axis=(1, 2)))
        if broken.size:
            raise DrivaxError(
                f"ego's motion is not finite in {broken.size} scenarios",
                record=names[int(broken[0])]["scenario_id"],
                cure="check the action space and the traffic",
            )


@partial(jax.jit, static_argnames="seed")
def _side_by_side(bank: ScenarioBank, rows: Int[Array, " W"], seed: int) -> tuple[ScenarioBank, Array]:
    """These rows of a bank as a bank of their own, and their keys."""
    some = bank.part(rows)
    return some, episode_keys(some, jnp.arange(len(rows)), seed)


def _joined(parts: Sequence[Episodes]) -> Episodes:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _on(progress: Progress | None, first: int, total: int) -> Progress | None:
    """Progress over a part of all, as progress over all."""
    return None if progress is None else lambda done, _: progress(first + done, total)


def _refuse_without_future(names: Sequence[Mapping[str, str]], without: Sequence[bool] | Any) -> None:
    short = [row["scenario_id"] for row, cut in zip(names, without, strict=True) if cut]
    if short:
        raise DataError(
            f"has no logged future (a short log or a test split), as {len(short)} of {len(names)} scenarios",
            record=short[0],
            cure="leave them out with --filter flag!=NO_FUTURE",
        )
