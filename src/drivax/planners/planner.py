"""The interface of planners: frozen records whose memory travels in their carry."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.simulator.types import Action, SimState, Situation
from drivax.tasks.actions import ActionSpace, action_of


@runtime_checkable
class Planner(Protocol):
    """A driver, unbatched and pure.

    Register implementations as pytrees (weights are leaves, settings are static): evaluation passes the planner as an
    argument of its compiled program. The compiler removes inputs that ``act`` does not read. A planner that needs
    stored scenarios has ``prepare(scenario_of)``, which evaluation calls with a function from a scenario's identity to
    the scenario.
    """

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    @property
    def replays(self) -> bool:
        """Whether the logged motion is replayed exactly instead of driving the action through the dynamics."""
        ...

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Any:
        """Return the carry at the start of an episode."""
        ...

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return an action of the task's action space, which the simulator clips, and the carry of the next step."""
        ...


class Memoryless:
    """Base of planners without memory; implement ``choose`` or override ``act``."""

    replays: bool = False

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[()]:
        """Return an empty carry."""
        return ()

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return the chosen action."""
        return self.choose(bank, situation, observation, key), carry

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return an action of the task's action space."""
        raise NotImplementedError


class RuleBased(Memoryless, ABC):
    """Base of planners that compute acceleration and curvature from the situation; subclasses define ``actions``."""

    actions: ActionSpace

    @abstractmethod
    def controls(self, bank: ScenarioBank, situation: Situation) -> tuple[Scalar, Scalar]:
        """Return acceleration (m/s2) and curvature (1/m)."""

    def choose(self, bank: ScenarioBank, situation: Situation, observation: Any, key: Array) -> Action:
        """Return the action that applies the controls in the planner's action space."""
        return action_of(self.actions, bank, situation.context, *self.controls(bank, situation))


@record
class Held:
    """A planner whose decisions are executed for several steps (``Task.hold``).

    Poses of ``trajectory`` and ``direct_state`` are repeated as they are: a plan is tracked from its first pose again.
    """

    planner: Any
    steps: int = static()

    @property
    def name(self) -> str:
        """Name of the planner."""
        return self.planner.name

    @property
    def replays(self) -> bool:
        """Whether the planner replays the log."""
        return self.planner.replays

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[Any, Action]:
        """Return the planner's carry, and zeros in place of the first decision."""
        return self.planner.init(bank, state, key), jnp.zeros_like(state.context.action)

    def act(
        self, carry: tuple[Any, Action], bank: ScenarioBank, state: SimState, situation: Situation,
        observation: Any, key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return a new action of the planner at every ``steps``-th step of an episode, and repeat it until the next."""
        decision = self.planner.act(carry[0], bank, state, situation, observation, key)
        is_decision_step = (state.context.step - state.start) % self.steps == 0
        action, inner_carry = jax.tree.map(
            lambda new, old: jnp.where(is_decision_step, new, old), decision, (carry[1], carry[0])
        )
        return action, (inner_carry, action)


def hold(planner: Planner, steps: int) -> Planner:
    """Return a planner whose decisions are executed for ``steps`` steps."""
    return planner if steps == 1 else Held(planner, steps)
