"""Mixtures of traffic: blocks of environments, each with its own traffic."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.learning.config import SELF, TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.environment import Environments, Outcome, PastPolicy
from drivax.learning.experience import ExpertActions, ExpertSteps, StepIndex
from drivax.learning.policies import find_traffic
from drivax.learning.self_play import SelfPlay, refuse_stored_states
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.types import SimState


@dataclass(frozen=True)
class Mixture:
    """Blocks of environments that differ in their traffic; a batch concatenates those of the blocks in order.

    Logged steps and shapes of observations are the same in all blocks.

    Attributes:
        blocks: Environment of each block by the name of its traffic.
        shares: Share of the environments of each block.
    """

    blocks: tuple[tuple[str, Driving], ...]
    shares: tuple[float, ...]

    @property
    def action_size(self) -> int:
        """Number of components of an action."""
        return self._first.action_size

    @property
    def levels(self) -> tuple[tuple[float, ...], ...] | None:
        """Levels of a discrete action space, None of a continuous one."""
        return self._first.levels

    @property
    def penalties(self) -> dict[str, float]:
        """Penalties of the reward, as in :class:`~drivax.learning.driving.Driving`."""
        return self._first.penalties

    @property
    def _first(self) -> Driving:
        return self.blocks[0][1]

    def prepare(self, data: ScenarioBank) -> ScenarioBank:
        """Return the bank with the data of all traffic models.

        Raises:
            UsageError: Two of them need different data of one type, such as two policies.
        """
        for name, block in self.blocks:
            before = getattr(data, "traffic", ())
            data = block.prepare(data)
            after = [id(record) for record in getattr(data, "traffic", ())]
            if not all(id(record) in after for record in before):
                cure = "mix at most one trained policy, and one kind of reactive vehicles"
                raise UsageError(f"traffic {name} replaces data of another traffic", cure=cure)
        return data

    def past(self, count: int) -> PastPolicy:
        """Return the environments of the self-play block, if any, that an older copy of the policy drives."""
        sizes = self.sizes(count)
        offsets = accumulate(sizes[:-1], initial=0)
        for (_, block), size, offset in zip(self.blocks, sizes, offsets, strict=True):
            if isinstance(block, SelfPlay):
                past = block.past(size)
                return past._replace(environments=offset + past.environments)
        return PastPolicy(np.arange(0), 1)

    def shapes(self, data: ScenarioBank) -> dict[str, tuple[int, ...]]:
        """Return the shape of each group of one observation."""
        return self._first.shapes(data)

    def start(self, data: ScenarioBank, key: Array, count: int) -> Environments:
        """Reset the environments of every block to random steps of their logs."""
        keys = jax.random.split(key, len(self.blocks))
        blocks = zip(self.blocks, keys, self.sizes(count), strict=True)
        return _concatenate([block.start(data, key, size) for (_, block), key, size in blocks])

    def stored(self, state: Any) -> NoReturn:
        """Raise UsageError: a replay buffer cannot store states, because they differ between blocks."""
        refuse_stored_states("a mixture of traffic")

    def observe_all(self, data: ScenarioBank, stored: Any) -> NoReturn:
        """Raise the error of :meth:`stored`."""
        self.stored(stored)

    def cache(self, data: ScenarioBank, state: tuple[SimState, ...]) -> tuple[Any, ...]:
        """Return the cache of every block."""
        pairs = zip(self.blocks, state, strict=True)
        return tuple(block.cache(data, states) for (_, block), states in pairs)

    def draw(self, data: ScenarioBank, key: Array, count: int) -> list[Any]:
        """Draw the starts of new episodes of every block."""
        keys = jax.random.split(key, len(self.blocks))
        blocks = zip(self.blocks, keys, self.sizes(count), strict=True)
        return [block.draw(data, key, size) for (_, block), key, size in blocks]

    def step(
        self, data: ScenarioBank, now: Environments, cache: Any, action: Float[Array, "B D"], drawn: Any
    ) -> tuple[Environments, Outcome]:
        """Step or reset the environments of every block; devices sum the totals of all blocks in every step."""
        sizes = self.sizes(len(action))
        after, outcomes = [], []
        for number, (start, end) in enumerate(pairwise(accumulate(sizes, initial=0))):
            over, observation, actions = jax.tree.map(
                lambda leaf, start=start, end=end: leaf[start:end], (now.over, now.observation, action)
            )
            environments, block = Environments(now.state[number], over, observation), self.blocks[number][1]
            environments, outcome = block.step(data, environments, cache[number], actions, drawn[number])
            after.append(environments)
            outcomes.append(outcome)
        totals = jax.tree.map(
            lambda *sums: sum(map(jnp.sum, sums)), *(outcome.totals for outcome in outcomes)
        )
        caches = tuple(outcome.cache for outcome in outcomes)
        outcome = jax.tree.map(_join, *(replace(outcome, cache=(), totals={}) for outcome in outcomes))
        return _concatenate(after), replace(outcome, cache=caches, totals=totals)

    def demonstrations(self, data: ScenarioBank, key: Array, count: int) -> ExpertActions:
        """Return the expert's actions at random steps of the log."""
        return self._first.demonstrations(data, key, count)

    def observe_recorded(self, data: ScenarioBank, index: StepIndex) -> dict[str, Array]:
        """Observe logged steps as in :meth:`demonstrations`."""
        return self._first.observe_recorded(data, index)

    def expert_steps(self, data: ScenarioBank) -> ExpertSteps:
        """Return the log as a rollout of the expert."""
        return self._first.expert_steps(data)

    def sizes(self, count: int) -> tuple[int, ...]:
        """Return the number of environments of each block: see :func:`divide`.

        Raises:
            UsageError: A block has none.
        """
        groups = {name: block.config.vehicles for name, block in self.blocks if isinstance(block, SelfPlay)}
        shares = {name: share for (name, _), share in zip(self.blocks, self.shares, strict=True)}
        sizes = divide(count, shares, groups)
        for name, size in sizes.items():
            if size < 1:
                problem = f"traffic {name} has a share of {shares[name]:g} of {count} environments: none"
                raise UsageError(problem, cure="raise environments or the share")
        return tuple(sizes.values())


def training_environment(config: TrainConfig, trust: Sequence[str] = ()) -> Driving | Mixture:
    """Return the environment of a training run: one block, or a mixture of several.

    ``trust`` are the modules whose code policies in the traffic may name.
    """

    def block(name: str) -> Driving:
        return (
            config.self_play_environment() if name == SELF else config.environment(find_traffic(name, trust))
        )

    blocks = tuple((name, block(name)) for name in config.shares)
    return blocks[0][1] if len(blocks) == 1 else Mixture(blocks, tuple(config.shares.values()))


def divide(count: int, shares: Mapping[str, float], groups: Mapping[str, int]) -> dict[str, int]:
    """Divide environments by shares, with the largest remainder method.

    Blocks in ``groups``, which maps them to a group's size, first get the closest number of groups, at least one.
    """
    sizes = {name: size * max(round(shares[name] * count / size), 1) for name, size in groups.items()}
    others = {name: share for name, share in shares.items() if name not in groups}
    rest = max(count - sum(sizes.values()), 0)
    quotas = {name: rest * share / sum(others.values()) for name, share in others.items()}
    sizes |= {name: math.floor(quota) for name, quota in quotas.items()}
    by_remainder = sorted(quotas, key=lambda name: sizes[name] - quotas[name])
    for name in by_remainder[: rest - sum(sizes[name] for name in others)]:
        sizes[name] += 1
    return {name: sizes[name] for name in shares}


def _concatenate(blocks: list[Environments]) -> Environments:
    """Return the environments of blocks as one batch, with a tuple of states."""
    over, observation = jax.tree.map(_join, *((block.over, block.observation) for block in blocks))
    return Environments(tuple(block.state for block in blocks), over, observation)


def _join(*leaves: Array) -> Array:
    return jnp.concatenate(leaves)
