"""Closed loop on the device: a planner drives a batch of scenarios from a start step to the end of the log."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int16

from drivax.evaluation.episode_table import FAILED
from drivax.evaluation.traffic_trajectories import packed
from drivax.metrics.episode import episode_metrics, event_steps
from drivax.metrics.steps import Value
from drivax.planners.planner import Planner
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import CURRENT_STEP
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import SimState
from drivax.tasks.task import Task

#: What the key of an episode is folded with to draw its start.
_START = 1


@record
class Episodes:
    """What a batch of episodes came to.

    Attributes:
        metrics: Every metric by name.
        events: Step of the first collision, off-road step and red light, -1 for none.
        motion: x, y, heading, speed of the driven agent from the start step to the end.
        actions: What was carried out in each step: within bounds, and as the actuators let it be.
        others: Poses of the other agents at each step (``evaluation.traffic_trajectories``); None in log traffic.
        offroad_steps: Number of steps off the road.
        crashed: First step whose action was no number, -1 for none. Nothing is measured from there on; motion stays.
    """

    metrics: dict[str, Value]
    events: dict[str, Int[Array, "*batch"]]
    motion: Float[Array, "*batch steps 4"]
    actions: Float[Array, "*batch actions D"]
    others: Int16[Array, "*batch steps A 3"] | None
    offroad_steps: Int[Array, "*batch"]
    crashed: Int[Array, "*batch"]


def episode_keys(bank: ScenarioBank, index: Int[Array, " B"], seed: int) -> Array:
    """A random key for each scenario, which follows from the seed and from who it is, not from where it stands."""
    return jax.vmap(jax.random.fold_in, (None, 0))(jax.random.key(seed), bank.identity[index])


def judging(task: Task) -> Task:
    """The task as evaluation runs it: failures are recorded, episodes go on to the end of the log, with all metrics."""
    own = task.metrics if isinstance(task.metrics, tuple) else ()
    return replace(task, to_the_end=True, metrics=("full", *own))


@partial(jax.jit, static_argnames=("simulator", "start_step"))
def drive(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, index: Int[Array, " B"], keys: Array,
    start_step: int = CURRENT_STEP, slot: Any = 0,
) -> Episodes:  # fmt: skip
    """Run one planner on scenarios ``index``; one compilation per planner kind, batch size and start step.

    Args:
        simulator: With a task whose episodes do not end early (:func:`judging`).
        planner: The driver.
        bank: The scenarios.
        index: Rows of the bank.
        keys: A random key each.
        start_step: Step of the log at which to begin.
        slot: Which agent is driven.
    """
    episode = partial(_episode, simulator, planner, bank, start_step, slot)
    return jax.vmap(episode)(index, keys)


def _episode(
    simulator: Simulator,
    planner: Planner,
    bank: ScenarioBank,
    start_step: int,
    slot: Any,
    index: Array,
    key: Array,
) -> Episodes:
    state = simulator.reset(bank, index, start_step, slot, jax.random.fold_in(key, _START))
    begin_key, key = jax.random.split(key)
    carry = planner.init(bank, state, begin_key)

    def others(state: SimState) -> Int16[Array, "A 3"] | None:
        traffic = simulator.traffic
        return None if traffic.name == LogTraffic.name else packed(traffic.agents(bank, state.context, 0))

    def step(now: Any, key: Array) -> Any:
        state, kept, carry, sound = now
        state, carry, step_sound = advanced(simulator, planner, bank, state, carry, key)
        sound &= step_sound
        kept = state if planner.replays else jax.tree.map(partial(jnp.where, sound), state, kept)
        context = kept.context
        seen = context.history[-1], context.action, sound & state.facts.offroad, sound, others(state)
        return (state, kept, carry, sound), seen

    keys = jax.random.split(key, bank.steps - 1 - start_step)
    first = (state, state, carry, jnp.ones((), bool))
    (last, final, _, _), (motion, actions, offroad, sound, moved) = jax.lax.scan(step, first, keys)
    began = others(state)
    metrics, to_the_end = episode_metrics(bank, final), episode_metrics(bank, last)
    # What a scenario defines does not depend on how soon its planner crashed.
    failed = {
        name: replace(metrics[name], defined=to_the_end[name].defined) for name in FAILED if name in metrics
    }
    return Episodes(
        metrics=metrics | failed,
        events=event_steps(final.episode),
        motion=jnp.concatenate([state.context.history[-1][None], motion]),
        actions=actions,
        others=None if began is None else jnp.concatenate([began[None], moved]),
        offroad_steps=offroad.sum().astype(jnp.int32),
        crashed=jnp.where(sound.all(), -1, start_step + jnp.argmin(sound)),
    )


def advanced(
    simulator: Simulator, planner: Planner, bank: ScenarioBank, state: SimState, carry: Any, key: Array
) -> tuple[SimState, Any, Bool[Array, ""]]:
    """State and carry one step later, the planner driving or, where it replays, the log; and whether it gave numbers.

    Where it did not, nothing is asked of the car (``Task.first_action``), so that its state stays one of a car.
    """
    situation = simulator.situation(bank, state)
    observation = simulator.observe(bank, state.context)
    action, carry = planner.act(carry, bank, state, situation, observation, key)
    if planner.replays:
        action = simulator.task.actuated(state.context.history[-1], action, state.context.action)
        logged = logged_motion(bank, state.context, 1)
        return simulator.replay(bank, state, logged, action)[0], carry, jnp.ones((), bool)
    context, sound = state.context, jnp.isfinite(action).all()
    length_m = bank.length_m(context.index, context.slot)
    nothing = simulator.task.first_action(context.history, length_m)
    return simulator.step(bank, state, jnp.where(sound, action, nothing))[0], carry, sound
