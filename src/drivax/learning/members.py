"""Agents that differ in their seed alone and learn side by side, in one program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.learning.algorithm import Learner


@dataclass(frozen=True)
class Agents:
    """One learner with one seed or several; states of several are stacked along a leading axis.

    Attributes:
        learner: The learner.
        seeds: The seed of each.
    """

    learner: Learner
    seeds: tuple[int, ...]

    @property
    def several(self) -> bool:
        """Whether there is a leading axis."""
        return len(self.seeds) > 1

    def init(self, data: Any) -> Any:
        """The state before the first iteration."""
        if not self.several:
            return self.learner.init(data, jax.random.key(self.seeds[0]))
        keys = jnp.stack([jax.random.key(seed) for seed in self.seeds])
        return jax.vmap(self.learner.init, (None, 0))(data, keys)

    def iterate(self, data: Any, state: Any) -> tuple[Any, dict[str, Array]]:
        """The state after one iteration of all, and what each logs."""
        if not self.several:
            return self.learner.iterate(data, state)
        return jax.vmap(self.learner.iterate, (None, 0))(data, state)

    def shapes_of_one(self, shapes: Any) -> Any:
        """Shapes of the state of one agent, from those of the state of all."""
        rank = int(self.several)
        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[rank:], leaf.dtype), shapes)

    def one(self, tree: Any, number: int) -> Any:
        """What belongs to one agent: of its state, a part of it, or what is logged."""
        return jax.tree.map(lambda leaf: leaf[number], tree) if self.several else tree

    def together(self, states: Sequence[Any]) -> Any:
        """The state of all, from the state of each."""
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states) if self.several else states[0]
