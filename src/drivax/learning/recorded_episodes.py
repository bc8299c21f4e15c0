"""Recorded episodes: evaluations of any planners, as logged steps that offline algorithms learn from.

An evaluation stores the motion and the executed actions of its planner. Before training, every episode is replayed once
with the rewards and episode ends of the training task. Only what observations depend on is kept: some 60 bytes per step
in log traffic, more in reactive traffic.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from drivax.learning.driving import BATCH, Driving
from drivax.learning.experience import ExpertSteps, StepIndex
from drivax.planners.simple import logged_motion
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import HISTORY, AgentContext
from drivax.tasks.actions import Route


@record
class RecordedEpisodes:
    """M episodes in the scenarios of a bank, at T steps of the log.

    Attributes:
        bank: The scenarios.
        contexts: Fields of the context (:class:`~drivax.simulator.types.AgentContext`) at these steps, ``[M, T, ...]``,
            without its ``history``.
        motion: x, y (m), heading (rad), speed (m/s) at these steps, and at the ``HISTORY - 1`` steps before the first.
        steps: Actions of the planners and their outcome.
    """

    bank: ScenarioBank
    contexts: dict[str, Any]
    motion: Float[Array, "M times 4"]
    steps: ExpertSteps


@dataclass(frozen=True)
class RecordedDriving(Driving):
    """Recorded episodes as an environment of logged steps; its data are :class:`RecordedEpisodes`."""

    start_step: int = 0

    def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation."""
        return super().shapes(data.bank)

    def expert_steps(self, data: Any) -> ExpertSteps:
        """Return the steps of the episodes."""
        return data.steps

    def observe_recorded(self, data: Any, index: StepIndex) -> dict[str, Array]:
        """Observe steps of the episodes."""
        row, step = index
        values = jax.tree.map(lambda leaf: leaf[row, step], data.contexts)
        history = data.motion[row[..., None], step[..., None] + jnp.arange(HISTORY)]
        return self.observe_all(data.bank, AgentContext(**values, history=history))

    def replay(
        self, bank: ScenarioBank, episode: tuple[Int[Array, ""], Float[Array, "S 4"], Float[Array, "S1 D"]]
    ) -> tuple[dict[str, Any], Float[Array, "times 4"], tuple[Array, ...]]:
        """Replay an episode, which begins as logged.

        Returns contexts and motion from ``start_step`` on, and for each step the action, the reward, the episode ends,
        and whether the action does not lead to the next state: it exceeds the bounds, or reaches them in an exact
        replay of the log, where evaluations clip it.
        """
        index, motion, action = episode
        simulator = Simulator(replace(self.task, metrics="none"), self.simulator.traffic)
        initial = simulator.reset(bank, index, self.start_step)

        def step(state: Any, episode: tuple[Array, Array]) -> tuple[Any, tuple[Any, ...]]:
            motion, action = episode
            after, result = simulator.replay(bank, state, motion, action)
            is_logged = (motion == logged_motion(bank, state.context, 1)).all()
            space = self.task.actions
            # In the space ``route``, the executed action is not in the space of the requested one.
            if isinstance(space, Route):
                action = space.unsteer(bank, state.context, action)
            clipped = space.exceeds_bounds(action)
            action = jnp.clip(action, -1.0, 1.0)
            outcome = (action, result.reward, result.terminated, result.truncated)
            return after, (_without_history(state.context), outcome, clipped, is_logged)

        final, (contexts, outcome, clipped, is_logged) = jax.lax.scan(step, initial, (motion[1:], action))
        last = jax.tree.map(lambda leaf: leaf[None], _without_history(final.context))
        contexts = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), contexts, last)
        clipped |= is_logged.all() & (jnp.abs(outcome[0]) >= 1.0).any(axis=-1)
        return contexts, jnp.concatenate([initial.context.history[:-1], motion]), (*outcome, clipped)


def _without_history(context: AgentContext) -> dict[str, Any]:
    return {field.name: getattr(context, field.name) for field in fields(context) if field.name != "history"}


def replay_episodes(
    environment: RecordedDriving, bank: ScenarioBank, index: Int[Array, " M"], motion: Float[Array, "M S 4"],
    action: Float[Array, "M S1 D"],
) -> RecordedEpisodes:  # fmt: skip
    """Replay all episodes, in batches."""
    # A compiled function that returned the bank would copy it.
    return RecordedEpisodes(bank, *_replay_all(environment, bank, index, motion, action))


@partial(jax.jit, static_argnums=0)
def _replay_all(
    environment: RecordedDriving, bank: ScenarioBank, index: Int[Array, " M"], motion: Float[Array, "M S 4"],
    action: Float[Array, "M S1 D"],
) -> tuple[dict[str, Any], Float[Array, "M times 4"], ExpertSteps]:  # fmt: skip
    """Return contexts, motion and steps of all episodes, as in :class:`RecordedEpisodes`."""
    finite = jnp.isfinite(action).all(axis=-1)
    action = jnp.where(finite[..., None], action, 0.0)
    replay = partial(environment.replay, bank)
    contexts, motion, outcome = jax.lax.map(
        replay, (index, motion, action), batch_size=min(len(index), BATCH)
    )
    start = environment.start_step

    def pad(values: Array, last: int = 0) -> Array:
        """Pad by zeros before the start, and at the last step, which has no successor."""
        return jnp.pad(values, ((0, 0), (start, last), *((0, 0),) * (values.ndim - 2)))

    action, reward, terminated, truncated, clipped = (pad(values, 1) for values in outcome)
    ends, time = terminated | truncated, jnp.arange(action.shape[1])
    over = jnp.cumsum(ends, axis=1) > ends
    is_decision = (time - start) % environment.task.hold == 0
    usable = pad(finite, 1) & ~over & (time >= start)
    steps = ExpertSteps(
        action, reward, terminated, truncated, usable, clipped | ~is_decision, environment.task.hold,
        scenarios=len(bank), scenario=index,
    )  # fmt: skip
    return jax.tree.map(pad, contexts), pad(motion), steps
