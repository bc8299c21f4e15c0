"""The one interface of drivers. A planner is a frozen record; what it computed earlier travels in its carry."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.simulator.types import SimState, Situation


@runtime_checkable
class Planner(Protocol):
    """A driver, unbatched and pure.

    Register implementations as pytrees (weights are leaves, settings static): an evaluation passes the planner as an
    argument of its compiled program. What ``act`` does not read is not computed.

    Attributes:
        name: As printed in tables.
        replays: The logged motion is replayed exactly instead of driving the action through the dynamics.
    """

    @property
    def name(self) -> str:
        """As printed in tables."""
        ...

    @property
    def replays(self) -> bool:
        """Whether the log's motion is replayed exactly."""
        ...

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Any:
        """The carry at the start of an episode."""
        ...

    def act(
        self,
        carry: Any,
        bank: ScenarioBank,
        state: SimState,
        situation: Situation,
        observation: Any,
        key: Array,
    ) -> tuple[Float[Array, " D"], Any]:
        """An action of the task's action space, and the carry for the next step."""
        ...


class Memoryless:
    """Mixed into planners that carry nothing from step to step."""

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[()]:
        """Nothing to carry."""
        return ()
