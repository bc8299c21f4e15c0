"""A trained policy as a planner."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from drivax.scenario.bank import ScenarioBank
from drivax.simulator.types import SimState, Situation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkPlanner:
    """Acts by the policy's mode, or by a sample.

    Attributes:
        parameters: Weights of the policy network.
        graph: Its structure.
        name: As printed in tables.
        samples: Whether to act by a sample.
    """

    parameters: Any
    graph: Any = field(metadata={"static": True})
    name: str = field(default="policy", metadata={"static": True})
    samples: bool = field(default=False, metadata={"static": True})
    replays: bool = field(default=False, metadata={"static": True})

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[()]:
        """Nothing to carry."""
        return ()

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, "2"], Any]:
        """The policy's action for the observation."""
        distribution = nnx.merge(self.graph, self.parameters)(observation)
        action = jnp.tanh(distribution.sample(key)) if self.samples else distribution.mode()
        return action, carry
