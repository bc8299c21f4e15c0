"""A trained policy as a planner."""

from __future__ import annotations

from typing import Any

from flax import nnx
from jaxtyping import Array, Float

from drivax.planners.planner import Memoryless
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import SimState, Situation


@record
class NetworkPlanner(Memoryless):
    """Acts by the policy's mode, or by a sample.

    Attributes:
        parameters: Weights of the policy network.
        graph: Its structure.
        name: As printed in tables.
        samples: Whether to act by a sample.
    """

    parameters: Any
    graph: Any = static()
    name: str = static(default="policy")
    samples: bool = static(default=False)
    replays: bool = static(default=False)

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Float[Array, "2"], Any]:  # fmt: skip
        """The policy's action for the observation."""
        distribution = nnx.merge(self.graph, self.parameters)(observation)
        return distribution.action(distribution.sample(key)) if self.samples else distribution.mode(), carry
