"""Criticality by failures and near misses of planners in closed loop.

The score of a step of the log is that of the planner's episode at the same time, where the planner may be elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from drivax.curation.kinematic import scale_urgency
from drivax.curation.logged import Numbers, Progress, map_batches
from drivax.errors import DataError, UsageError
from drivax.evaluation.episode_table import EpisodeTable
from drivax.metrics.catalogue import EVENTS
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import DT_S
from drivax.scenario.store import ScenarioSet
from drivax.simulator.contact import TTC_HORIZON_S
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.bank_data import prepare_bank
from drivax.simulator.traffic.reactive import TRAFFIC, make_traffic
from drivax.tasks.rewards import RewardConfig
from drivax.tasks.task import Task

#: A task whose reward reads the time to collision, so that the simulator computes it.
_TASK = Task(rewards=RewardConfig("safety", urgency=-1.0), metrics="none", to_the_end=True)


@dataclass(frozen=True)
class FailureConfig:
    """Scales of the components.

    Attributes:
        before_s: Time before a failure over which its component rises from 0 to 1.
        urgent_s: Time to collision at which ``near_miss`` is 1.
        at_fault: Whether a collision counts only if it is the planner's fault.
    """

    before_s: float = 3.0
    urgent_s: float = 0.95
    at_fault: bool = True

    def __post_init__(self) -> None:
        if not (0.0 < self.before_s < float("inf") and 0.0 < self.urgent_s < TTC_HORIZON_S):
            problem = f"before_s is {self.before_s}, urgent_s {self.urgent_s}"
            raise UsageError(problem, cure=f"use more than 0, and urgent_s below {TTC_HORIZON_S}")


def failure_components(
    config: FailureConfig, runs: Sequence[EpisodeTable], data: ScenarioSet, progress: Progress | None = None
) -> dict[str, Float[Numbers, "N T"]]:
    """Return components of every step of a set, means over the episodes of each scenario in all runs.

    ``failure`` rises towards the first collision, off-road step and red light, and is 0 after them; ``near_miss`` is
    the scaled inverse time to collision, 0 before the start of the episodes. Both are 0 without an episode.

    Raises:
        UsageError: There is no run, or the traffic of a run cannot be simulated again.
        DataError: A run is of another set, or its trajectories are damaged.
    """
    if not runs:
        raise UsageError("no evaluation to find failures in", cure="pass --runs RUN")
    shape = len(data), data.capacity.steps
    sums = {"failure": np.zeros(shape), "near_miss": np.zeros(shape)}
    count = np.zeros(len(data))
    row_of = {(str(e["dataset"]), str(e["scenario_id"])): row for row, e in enumerate(data.entries)}
    for run in runs:
        if run.data.get("hash") != data.hash:
            raise DataError(
                f"its episodes are not in {data.path}", file=run.folder, cure="evaluate on this set"
            )
        episodes = [number for number, key in enumerate(run.scenarios) if key in row_of]
        rows = np.array([row_of[run.scenarios[number]] for number in episodes], int)
        np.add.at(sums["failure"], rows, _failures(config, run, shape[1])[episodes])
        np.add.at(sums["near_miss"], rows, _near_misses(config, run, data, row_of, progress)[rows])
        np.add.at(count, rows, 1.0)
    return {name: total / np.maximum(count, 1.0)[:, None] for name, total in sums.items()}


def _failures(config: FailureConfig, run: EpisodeTable, steps: int) -> Float[Numbers, "E T"]:
    """Return the component ``failure`` of each episode."""
    step, result = np.arange(steps), np.zeros((len(run), steps))
    for name in EVENTS:
        event = run.trajectories.events[name].copy()
        if name == "collision" and config.at_fault and "at_fault_collision" in run.metrics:
            event[~(run.metrics["at_fault_collision"] > 0)] = -1
        until_s = (event[:, None] - step) * DT_S
        rise = np.where((event[:, None] >= 0) & (until_s >= 0.0), 1.0 - until_s / config.before_s, 0.0)
        result = np.maximum(result, rise)
    return result


def _near_misses(
    config: FailureConfig,
    run: EpisodeTable,
    data: ScenarioSet,
    row_of: dict[Any, int],
    progress: Progress | None,
) -> Float[Numbers, "N T"]:
    """Return the scaled inverse time to collision along the motion of each scenario's last episode."""
    ego, starts = run.trajectories.ego, set(run.trajectories.start.tolist())
    if len(starts) != 1 or not np.isfinite(ego).all():
        raise DataError(
            "episodes begin at different steps, or are not finite", file=run.folder, cure="evaluate again"
        )
    (start,) = starts
    motion = np.zeros((len(data), *ego.shape[1:]), np.float32)
    for number, key in enumerate(run.scenarios):
        if key in row_of:
            motion[row_of[key]] = ego[number]
    if ego.shape[1] != data.capacity.steps - start:
        raise DataError(f"episodes of {ego.shape[1]} steps", file=run.folder, cure="evaluate again")
    if run.traffic not in TRAFFIC:
        problem = f"its traffic is {run.traffic}, which is not simulated again"
        raise UsageError(problem, file=run.folder, cure=f"evaluate in {' or '.join(TRAFFIC)}")
    simulator = Simulator(_TASK, make_traffic(run.traffic))

    def urgency(bank: ScenarioBank, rows: Numbers) -> dict[str, Array]:
        bank = prepare_bank(simulator.traffic, bank)
        ttc_s = times_to_collision(simulator, bank, jnp.asarray(motion[rows]), int(start))
        return {"near_miss": scale_urgency(ttc_s, config.urgent_s)}

    return map_batches(data, urgency, progress)["near_miss"]


@partial(jax.jit, static_argnums=(0, 3))
def times_to_collision(
    simulator: Simulator, bank: ScenarioBank, motion: Float[Array, "N S 4"], start_step: int
) -> Float[Array, "N T"]:
    """Return the time to collision (s) along motions from a step on; the horizon before it and where undefined."""

    def episode(index: Int[Array, ""], motion: Float[Array, "S 4"]) -> Float[Array, " S"]:
        state = simulator.reset(bank, index, start_step)
        action = jnp.zeros(_TASK.actions.size)

        def step(state: Any, pose: Array) -> tuple[Any, Array]:
            after, _ = simulator.replay(bank, state, pose, action)
            facts = after.facts
            return after, jnp.where(facts.ttc_defined, facts.ttc_s, TTC_HORIZON_S)

        _, ttc_s = jax.lax.scan(step, state, motion[1:])
        first = jnp.where(state.facts.ttc_defined, state.facts.ttc_s, TTC_HORIZON_S)
        return jnp.concatenate([first[None], ttc_s])

    ttc_s = jax.vmap(episode)(jnp.arange(len(bank)), motion)
    return jnp.pad(ttc_s, ((0, 0), (start_step, 0)), constant_values=TTC_HORIZON_S)
