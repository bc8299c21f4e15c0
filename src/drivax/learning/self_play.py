"""Self-play: the policy in training drives several vehicles of a scenario, which see each other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.learning.driving import Driving, keep
from drivax.learning.environment import Environments, PastPolicy
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.schema import MOST_EGOS
from drivax.simulator.simulator import Step, is_driven, map_where
from drivax.simulator.types import AgentContext, EpisodeStart, SimState


@dataclass(frozen=True)
class SelfPlayConfig:
    """Settings of the traffic ``self``.

    Attributes:
        vehicles: Largest number of vehicles of a scenario that the policy drives, ego included; 2 to 8.
        past: Share of the groups in which an older copy of the policy drives all vehicles but ego (ppo and bc_ppo).
        refresh: Iterations after which the current policy replaces the older copy.
    """

    vehicles: int = 4
    past: float = 0.0
    refresh: int = 50

    def __post_init__(self) -> None:
        if not 2 <= self.vehicles <= MOST_EGOS:
            raise UsageError(f"self_play.vehicles is {self.vehicles}", cure=f"use 2 to {MOST_EGOS}")
        if not 0.0 <= self.past <= 1.0 or self.refresh < 1:
            problem = f"self_play.past is {self.past:g}, self_play.refresh {self.refresh}"
            raise UsageError(problem, cure="use a share from 0 to 1, and 1 iteration or more")


@dataclass(frozen=True)
class SelfPlay(Driving):
    """Driving in groups of environments, each a vehicle of the same scenario: the ego and further egos.

    Groups are contiguous. A group starts at a random step, as logged. The episode of each vehicle ends by itself; the
    vehicle then drives on without reward until all episodes of the group are over, and the group starts again in a
    newly drawn scenario. Environments without a vehicle, where a scenario has too few, are always over.
    """

    config: SelfPlayConfig = SelfPlayConfig()

    def past(self, count: int) -> PastPolicy:
        """Return the environments that an older copy of the policy drives: in the first groups, all but ego's.

        Raises:
            UsageError: The share of ``past`` rounds to no group.
        """
        size, environments = self.config.vehicles, np.arange(count)
        groups = round(self.config.past * (count // size))
        if self.config.past and not groups:
            problem = f"self_play.past is {self.config.past:g} of {count // size} groups: none"
            raise UsageError(problem, cure="raise it, or environments")
        is_past = (environments // size < groups) & (environments % size > 0)
        return PastPolicy(np.flatnonzero(is_past), self.config.refresh)

    def cache(self, data: ScenarioBank, state: SimState) -> Any:
        """Return nothing: a step computes a single frame per group."""
        return ()

    def stored(self, state: Any) -> NoReturn:
        """Raise UsageError: a replay buffer cannot store states, because observing one needs its whole group."""
        refuse_stored_states("self-play")

    def observe_all(self, data: ScenarioBank, stored: AgentContext) -> dict[str, Array]:
        """Observe the contexts of whole groups."""

        def observe(group: AgentContext) -> dict[str, Array]:
            return jax.vmap(lambda context: dict(self.simulator.observe(data, context, group)))(group)

        return _flatten(jax.vmap(observe)(self._groups(stored)))

    def _reset(self, data: ScenarioBank, key: Array, count: int) -> tuple[SimState, Bool[Array, " B"]]:
        size = self.config.vehicles
        if count % size:
            cure = f"use a multiple of {size} (self_play.vehicles)"
            raise UsageError(f"{count} environments of self-play", cure=cure)
        if size > data.most_egos:
            problem = f"self_play.vehicles is {size}, but the scenarios have {data.most_egos} with a route"
            raise UsageError(problem, cure="generate or convert them with --egos 8, or lower it")
        index, step, keys = self._draw_groups(data, key, count // size)
        slots, keys = jax.vmap(partial(self._slots, data))(index, step, keys)
        reset = jax.vmap(self.simulator.reset_together, (None, 0, 0, 0, 0))
        state = _flatten(reset(data, index, slots, step, keys))
        return state, ~is_driven(data, state)

    def draw(self, data: ScenarioBank, key: Array, count: int) -> Any:
        """Draw the starts of new episodes of groups, for ``count`` environments."""
        return self._draw_groups(data, key, count // self.config.vehicles, self.latest_start)

    def _step_or_reset(
        self, data: ScenarioBank, now: Environments, cache: Any, action: Float[Array, "B D"], start: Any
    ) -> Step:
        def new_episodes(index: Array, step: Array, key: Array) -> EpisodeStart:
            slots, keys = self._slots(data, index, step, key)
            return jax.vmap(partial(self.simulator.new_episode, data, index, step))(slots, keys)

        states, actions, over = self._groups((now.state, action, now.over))
        fresh = map_where(over.all(axis=1), new_episodes, *start)
        step_all = jax.vmap(self.simulator.step_together, (None, 0, 0, 0, 0))
        return _flatten(step_all(data, states, actions, over, fresh))

    def _step_on(
        self, data: ScenarioBank, state: SimState, action: Float[Array, "B D"], idle: Bool[Array, " B"]
    ) -> Step:
        states, actions, over = self._groups((state, action, idle))
        after, result = jax.vmap(self.simulator.step_together, (None, 0, 0, 0))(data, states, actions, over)
        return _flatten((keep(over.all(axis=1), states, after), result))

    def _over(
        self, data: ScenarioBank, state: SimState, over: Bool[Array, " B"], ends: Bool[Array, " B"]
    ) -> Bool[Array, " B"]:
        resets = jnp.repeat(self._groups(over).all(axis=1), self.config.vehicles)
        return jnp.where(resets, ~is_driven(data, state), over | ends)

    def _draw_groups(
        self, bank: ScenarioBank, key: Array, count: int, latest: int | None = None
    ) -> tuple[Int[Array, " G"], Int[Array, " G"], Array]:
        """Draw scenario, step and key of each group."""
        recorded = replace(self, egos="recorded")
        index, step, _, keys = recorded._draw(bank, key, count, self.earliest_start, latest)
        return index, step, keys

    def _slots(
        self, bank: ScenarioBank, index: Array, step: Array, key: Array
    ) -> tuple[Int[Array, " K"], Array]:
        """Return the slots of ego and of random egos whose logs have two more steps, padded, and a key for each."""
        padding, other_slots = bank.agents.shape[2], bank.egos[index, 1:]
        rows = index * bank.most_egos + jnp.arange(1, bank.most_egos)
        is_present = bank.agents[index, step, other_slots, AgentColumn.VALID] > 0
        is_present &= (other_slots >= 0) & (step <= bank.last_step[rows] - 2)
        rank = jnp.where(is_present, jax.random.uniform(key, other_slots.shape), jnp.inf)
        slots = jnp.where(is_present, other_slots, padding)[jnp.argsort(rank)[: self.config.vehicles - 1]]
        keys = jax.random.split(jax.random.fold_in(key, 1), self.config.vehicles)
        return jnp.pad(slots, (1, 0)).astype(jnp.int32), keys

    def _groups(self, tree: Any) -> Any:
        """Reshape a batch of environments ``[B, ...]`` into groups ``[G, K, ...]``."""
        size = self.config.vehicles
        return jax.tree.map(lambda leaf: leaf.reshape(len(leaf) // size, size, *leaf.shape[1:]), tree)


def _flatten(groups: Any) -> Any:
    """Reshape groups ``[G, K, ...]`` into a batch of environments ``[B, ...]``."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * leaf.shape[1], *leaf.shape[2:]), groups)


def refuse_stored_states(traffic: str) -> NoReturn:
    """Raise UsageError: a replay buffer cannot store the states of this traffic."""
    problem = f"a replay buffer cannot store states of {traffic}"
    raise UsageError(problem, cure="set replay.store to observation")
