"""A trained policy as a planner."""

from __future__ import annotations

from typing import Any

from flax import nnx
from jaxtyping import Array

from drivax.planners.planner import Memoryless
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import Action, Situation


@record
class NetworkPlanner(Memoryless):
    """A policy network that acts by its mode, or by a sample.

    Attributes:
        parameters: Weights of the network.
        graph: Structure of the network.
        samples: Whether to act by a sample.
    """

    parameters: Any
    graph: Any = static()
    name: str = static(default="policy")
    samples: bool = static(default=False)

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return the policy's action for the observation."""
        distribution = nnx.merge(self.graph, self.parameters)(observation)
        return distribution.action(distribution.sample(key)) if self.samples else distribution.mode()
