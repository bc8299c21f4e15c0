"""Closed-loop rollouts: a planner drives a batch of scenarios from a start step to the end of the log."""

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
from drivax.plugins import is_dotted
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import SimState, Traffic
from drivax.tasks.conditions import fix_conditions
from drivax.tasks.task import Task

#: Folded into an episode's key to draw its start.
_START_STREAM = 1
#: Units of packed positions (m) and headings (rad), and the bound of coordinates, within the range of int16.
_POSITION_UNIT_M, _HEADING_UNIT_RAD, _MAX_POSITION_M = 0.02, 1e-4, 650.0
#: Packed pose of an absent agent.
_ABSENT = -32768


@record
class Episodes:
    """Results of a batch of episodes.

    Attributes:
        metrics: Every metric by name.
        events: Step of the first collision, off-road position and red-light violation, -1 for none.
        motion: x, y (m), heading (rad) and speed (m/s) of the driven agent from the start step on; the last value is
            repeated after a crash and after the end of a short log.
        actions: Executed actions, within bounds and actuator rates, repeated in the same way.
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


@record
class _LoopState:
    """Carry of the loop over steps; ``metric_state`` stays at the last state before a non-finite action."""

    state: SimState
    metric_state: SimState
    carry: Any
    all_finite: Bool[Array, ""]


@record
class _StepOutput:
    """Contribution of one step to :class:`Episodes`."""

    motion: Float[Array, "4"]
    action: Float[Array, " D"]
    offroad: Bool[Array, ""]
    all_finite: Bool[Array, ""]
    others: Int16[Array, "A 3"] | None


def episode_keys(bank: ScenarioBank, index: Int[Array, " B"], seed: int) -> Array:
    """Return a random key for each scenario ``index``, derived from the seed and the scenario's identity."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), bank.identity[index])


def evaluation_task(task: Task) -> Task:
    """Return the task for evaluation: all metrics, fixed conditions, and episodes that last to the end of the log."""
    metrics = task.metrics
    if isinstance(metrics, str):
        metrics = (metrics,) if is_dotted(metrics) else ()
    conditions = fix_conditions(task.conditions)
    return replace(task, to_the_end=True, metrics=("full", *metrics), conditions=conditions)


def check_actions(planner: Planner, task: Task) -> None:
    """Check that planner and task have the same action space.

    Raises:
        UsageError: They differ.
    """
    if getattr(planner, "actions", task.actions) != task.actions:
        problem = f"planner {planner.name} has another action space than the task"
        raise UsageError(problem, cure="use the task's")


@partial(jax.jit, static_argnames=("simulator", "start_step"))
def drive(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, index: Int[Array, " B"], keys: Array,
    start_step: int = CURRENT_STEP, slot: Any = 0,
) -> Episodes:  # fmt: skip
    """Run a planner on scenarios ``index`` of a bank; ``slot`` is the driven agent.

    The task's episodes must not end early (:func:`evaluation_task`). The program is compiled once for each simulator,
    planner type, start step, batch size and bank size.
    """
    step = partial(_step, simulator, planner, bank)
    initial, step_keys = jax.vmap(partial(_start, simulator, planner, bank, start_step, slot))(index, keys)
    # Map the step, not the loop: to map a loop, JAX traces its body several times.
    final, outputs = jax.lax.scan(lambda loop, key: jax.vmap(step)(loop, key), initial, step_keys.T)
    outputs = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), outputs)
    return jax.vmap(partial(_outcome, simulator.traffic, bank, start_step))(initial, final, outputs)


def _start(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, start_step: int, slot: Any, index: Array, key: Array
) -> tuple[_LoopState, Array]:  # fmt: skip
    """Return the initial loop state of one episode, and a key for each of its steps."""
    state = simulator.reset(bank, index, start_step, slot, jax.random.fold_in(key, _START_STREAM))
    init_key, key = jax.random.split(key)
    loop = _LoopState(state, state, planner.init(bank, state, init_key), jnp.ones((), bool))
    return loop, jax.random.split(key, bank.steps - 1 - start_step)


def _step(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, loop: _LoopState, key: Array
) -> tuple[_LoopState, _StepOutput]:
    """Advance one episode by a step; its state no longer changes after the last step of its log."""
    state, context = loop.state, loop.state.context
    is_over = context.step >= bank.last_step[context.row]
    after, carry, is_finite = advance(simulator, planner, bank, state, loop.carry, key)
    state = jax.tree.map(partial(jnp.where, is_over), state, after)
    all_finite = loop.all_finite & (is_finite | is_over)
    metric_state = state
    if not planner.replays:  # A replay cannot crash.
        metric_state = jax.tree.map(partial(jnp.where, all_finite), state, loop.metric_state)
    context, offroad = metric_state.context, all_finite & ~is_over & state.facts.offroad
    others = _others(simulator.traffic, bank, state)
    output = _StepOutput(context.history[-1], context.action, offroad, all_finite, others)
    return _LoopState(state, metric_state, carry, all_finite), output


def _others(traffic: Traffic, bank: ScenarioBank, state: SimState) -> Int16[Array, "A 3"] | None:
    """Return packed poses of the other agents; None in log traffic."""
    return None if traffic.name == LogTraffic.name else pack_poses(traffic.agents(bank, state.context, 0))


def _outcome(
    traffic: Traffic, bank: ScenarioBank, start_step: int, initial: _LoopState, final: _LoopState, steps: _StepOutput
) -> Episodes:  # fmt: skip
    """Return the outcome of one episode from its initial and final state and the outputs of its steps."""
    metrics, full_metrics = episode_metrics(bank, final.metric_state), episode_metrics(bank, final.state)
    # Whether a metric is defined must not depend on when the planner crashed.
    names = [name for name in FAILED if name in metrics]
    failed_metrics = {name: replace(metrics[name], defined=full_metrics[name].defined) for name in names}
    others = _others(traffic, bank, initial.state)
    if others is not None and steps.others is not None:
        others = jnp.concatenate([others[None], steps.others])
    return Episodes(
        metrics=metrics | failed_metrics,
        events=event_steps(final.metric_state.episode),
        motion=jnp.concatenate([initial.state.context.history[-1][None], steps.motion]),
        actions=steps.action,
        others=others,
        offroad_steps=steps.offroad.sum().astype(jnp.int32),
        crashed=jnp.where(steps.all_finite.all(), -1, start_step + jnp.argmin(steps.all_finite)),
    )


def advance(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, state: SimState, carry: Any, key: Array
) -> tuple[SimState, Any, Bool[Array, ""]]:
    """Return the next state, the next carry, and whether the action was finite.

    A non-finite action is replaced by ``Task.coast``, so that the state stays finite. Planners with ``replays``
    follow the log.
    """
    situation = simulator.situation(bank, state)
    observation = simulator.observe(bank, state.context)
    action, carry = planner.act(carry, bank, state, situation, observation, key)
    context = state.context
    if planner.replays:
        action = simulator.task.actuate(bank, context, action)
        logged_pose = logged_motion(bank, context, 1)
        return simulator.replay(bank, state, logged_pose, action)[0], carry, jnp.ones((), bool)
    is_finite, coast = jnp.isfinite(action).all(), simulator.task.coast(bank, context)
    return simulator.step(bank, state, jnp.where(is_finite, action, coast))[0], carry, is_finite


def pack_poses(agents: Float[Array, "*batch A 8"]) -> Int16[Array, "*batch A 3"]:
    """Pack positions and headings (``AgentColumn``); agents with abs(x) or abs(y) of 650 m or more become absent."""
    xy = agents[..., AgentColumn.XY]
    heading = jnp.arctan2(agents[..., AgentColumn.SIN], agents[..., AgentColumn.COS])
    poses = jnp.concatenate([xy / _POSITION_UNIT_M, heading[..., None] / _HEADING_UNIT_RAD], axis=-1)
    present = (agents[..., AgentColumn.VALID] > 0) & (jnp.abs(xy) < _MAX_POSITION_M).all(axis=-1)
    return jnp.where(present[..., None], jnp.round(poses), _ABSENT).astype(jnp.int16)


def unpack_poses(packed: Int16[np.ndarray, "*batch A 3"]) -> Float32[np.ndarray, "*batch A 3"]:
    """Return x, y (m) and heading (rad) of packed poses, NaN for absent agents."""
    poses = packed * np.array([_POSITION_UNIT_M, _POSITION_UNIT_M, _HEADING_UNIT_RAD], np.float32)
    return np.where(packed == _ABSENT, np.nan, poses).astype(np.float32)
