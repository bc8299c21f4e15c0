"""Closed-loop rollouts on the device: a planner drives a batch of scenarios from a start step to the end of the log."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, Int16

from drivax.errors import UsageError
from drivax.evaluation.episode_table import FAILED
from drivax.metrics.episode import episode_metrics, event_steps
from drivax.metrics.steps import Value
from drivax.planners.planner import Planner
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import SimState
from drivax.tasks.task import Task

#: Number folded into the key of an episode to draw its start.
_START_STREAM = 1
#: Units of packed positions (m) and headings (rad), and the reach of int16 from a scenario's origin.
_POSITION_UNIT_M, _HEADING_UNIT_RAD, _MAX_POSITION_M = 0.02, 1e-4, 650.0
#: Stands for "absent" in a packed pose.
_ABSENT = -32768


@record
class Episodes:
    """The outcome of a batch of episodes.

    Attributes:
        metrics: Every metric by name.
        events: Step of the first collision, off-road step and red light, -1 for none.
        motion: x, y, heading, speed of the driven agent from the start step to the end; repeated beyond a short log.
        actions: Executed actions, after bounds and actuators; repeated beyond a short log.
        others: Packed poses of the other agents at each step (:func:`pack_poses`); None in log traffic.
        offroad_steps: Number of steps off the road.
        crashed: First step with a non-finite action, -1 for none; metrics cover the steps before it.
    """

    metrics: dict[str, Value]
    events: dict[str, Int[Array, "*batch"]]
    motion: Float[Array, "*batch steps 4"]
    actions: Float[Array, "*batch actions D"]
    others: Int16[Array, "*batch steps A 3"] | None
    offroad_steps: Int[Array, "*batch"]
    crashed: Int[Array, "*batch"]


def episode_keys(bank: ScenarioBank, index: Int[Array, " B"], seed: int) -> Array:
    """Return a random key for each scenario; it depends on the seed and the scenario's identity, not on its row."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), bank.identity[index])


def evaluation_task(task: Task) -> Task:
    """Return the task for evaluation: all metrics, and episodes that last to the end of the log."""
    own = task.metrics if isinstance(task.metrics, tuple) else ()
    return replace(task, to_the_end=True, metrics=("full", *own))


def check_actions(planner: Planner, task: Task) -> None:
    """Raise UsageError for a planner with another action space than the task."""
    if getattr(planner, "actions", task.actions) != task.actions:
        problem = f"planner {planner.name} has another action space than the task"
        raise UsageError(problem, cure="use the task's")


@partial(jax.jit, static_argnames=("simulator", "start_step"))
def drive(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, index: Int[Array, " B"], keys: Array,
    start_step: int = CURRENT_STEP, slot: Any = 0,
) -> Episodes:  # fmt: skip
    """Run one planner on rows ``index`` of a bank; one compilation per planner kind, batch size and start step.

    The task's episodes must not end early (:func:`evaluation_task`); ``slot`` is the driven agent.
    """
    episode = partial(_episode, simulator, planner, bank, start_step, slot)
    return jax.vmap(episode)(index, keys)


def _episode(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, start_step: int, slot: Any, index: Array, key: Array
) -> Episodes:  # fmt: skip
    state = simulator.reset(bank, index, start_step, slot, jax.random.fold_in(key, _START_STREAM))
    begin_key, key = jax.random.split(key)
    carry = planner.init(bank, state, begin_key)

    def others(state: SimState) -> Int16[Array, "A 3"] | None:
        traffic = simulator.traffic
        return None if traffic.name == LogTraffic.name else pack_poses(traffic.agents(bank, state.context, 0))

    def step(loop_state: Any, key: Array) -> Any:
        state, measured, carry, is_finite = loop_state
        # A log that is shorter than others of its bank ends earlier: its last state stays.
        ended = state.context.step >= bank.last_step[index]
        after, carry, finite = advance(simulator, planner, bank, state, carry, key)
        state = jax.tree.map(partial(jnp.where, ended), state, after)
        is_finite &= finite | ended
        measured = state if planner.replays else jax.tree.map(partial(jnp.where, is_finite), state, measured)
        context, offroad = measured.context, is_finite & ~ended & state.facts.offroad
        outputs = context.history[-1], context.action, offroad, is_finite, others(state)
        return (state, measured, carry, is_finite), outputs

    keys = jax.random.split(key, bank.steps - 1 - start_step)
    first = (state, state, carry, jnp.ones((), bool))
    (last, final, _, _), (motion, actions, offroad, is_finite, later_others) = jax.lax.scan(step, first, keys)
    others_first = others(state)
    metrics, uncut_metrics = episode_metrics(bank, final), episode_metrics(bank, last)
    # Whether a metric is defined must not depend on when the planner crashed.
    names = [name for name in FAILED if name in metrics]
    failed = {name: replace(metrics[name], defined=uncut_metrics[name].defined) for name in names}
    return Episodes(
        metrics=metrics | failed,
        events=event_steps(final.episode),
        motion=jnp.concatenate([state.context.history[-1][None], motion]),
        actions=actions,
        others=None if others_first is None else jnp.concatenate([others_first[None], later_others]),
        offroad_steps=offroad.sum().astype(jnp.int32),
        crashed=jnp.where(is_finite.all(), -1, start_step + jnp.argmin(is_finite)),
    )


def advance(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, state: SimState, carry: Any, key: Array
) -> tuple[SimState, Any, Bool[Array, ""]]:
    """Return state and carry one step later, and whether the action was finite; replaying planners follow the log.

    An action that is not finite is replaced by ``Task.coast``, so that the state stays finite.
    """
    situation = simulator.situation(bank, state)
    observation = simulator.observe(bank, state.context)
    action, carry = planner.act(carry, bank, state, situation, observation, key)
    context, motion = state.context, state.context.history[-1]
    length_m = bank.length_m(context.index, context.slot)
    if planner.replays:
        action = simulator.task.actuate(motion, action, context.action, length_m)
        logged = logged_motion(bank, context, 1)
        return simulator.replay(bank, state, logged, action)[0], carry, jnp.ones((), bool)
    is_finite, coast = jnp.isfinite(action).all(), simulator.task.coast(motion, length_m)
    return simulator.step(bank, state, jnp.where(is_finite, action, coast))[0], carry, is_finite


def pack_poses(agents: Float[Array, "*batch A 8"]) -> Int16[Array, "*batch A 3"]:
    """Pack positions and headings of bank rows; agents further than 650 m from the origin count as absent."""
    xy = agents[..., AgentColumn.XY]
    heading = jnp.arctan2(agents[..., AgentColumn.SIN], agents[..., AgentColumn.COS])
    poses = jnp.concatenate([xy / _POSITION_UNIT_M, heading[..., None] / _HEADING_UNIT_RAD], axis=-1)
    present = (agents[..., AgentColumn.VALID] > 0) & (jnp.abs(xy) < _MAX_POSITION_M).all(axis=-1)
    return jnp.where(present[..., None], jnp.round(poses), _ABSENT).astype(jnp.int16)


def unpack_poses(rows: Int16[np.ndarray, "*batch A 3"]) -> Float32[np.ndarray, "*batch A 3"]:
    """Return positions (m) and headings (rad), NaN where absent."""
    poses = rows * np.array([_POSITION_UNIT_M, _POSITION_UNIT_M, _HEADING_UNIT_RAD], np.float32)
    return np.where(rows == _ABSENT, np.nan, poses).astype(np.float32)
