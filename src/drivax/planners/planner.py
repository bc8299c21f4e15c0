"""The interface of planners: frozen records whose memory travels in their carry."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.ahead import FALLBACK_LIMIT_MPS
from drivax.simulator.types import MOTION_SPEED, Action, SimState, Situation
from drivax.tasks.actions import ActionSpace, Discrete, Physical, action_of

#: Correlation time of the noise on actions, s.
_CORRELATION_S = 1.0
#: Time constant of the speed limiter, s, and its largest deceleration, m/s2.
_LIMITER_S, _LIMITER_MPS2 = 1.0, 2.0


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
        """Whether the logged motion is replayed exactly, instead of applying actions to the dynamics."""
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


class _Wrapper:
    """Base of planners that change the actions of another one."""

    planner: Any

    @property
    def actions(self) -> ActionSpace:
        """Action space of the planner, if it has one of its own."""
        return self.planner.actions

    @property
    def prepare(self) -> Any:
        """Preparation of the planner, if it needs one."""
        return self.planner.prepare


@record
class Noisy(_Wrapper):
    """A planner with noise on its actions: Gaussian, with a correlation time of one second, independent per component.

    Attributes:
        planner: The planner.
        deviation: Standard deviation of the noise, in units of the action space.
    """

    planner: Any
    deviation: float = static()
    replays: bool = static(default=False)

    @property
    def name(self) -> str:
        """Name of the planner, with the deviation."""
        return f"{self.planner.name} (noise {self.deviation:g})"

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[Any, Action]:
        """Return the planner's carry, and the first noise."""
        planner_key, noise_key = jax.random.split(key)
        noise = self.deviation * jax.random.normal(noise_key, state.context.action.shape)
        return self.planner.init(bank, state, planner_key), noise

    def act(
        self, carry: tuple[Any, Action], bank: ScenarioBank, state: SimState, situation: Situation,
        observation: Any, key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return the planner's action with noise, and the carry with the noise of the next step."""
        planner_key, noise_key = jax.random.split(key)
        inner_carry, noise = carry
        action, inner_carry = self.planner.act(inner_carry, bank, state, situation, observation, planner_key)
        fresh = self.deviation * jax.random.normal(noise_key, noise.shape)
        # A first-order autoregressive process, whose variance stays constant.
        kept = math.exp(-DT_S / _CORRELATION_S)
        return action + noise, (inner_carry, kept * noise + math.sqrt(1.0 - kept**2) * fresh)


def add_noise(planner: Planner, deviation: float) -> Planner:
    """Return a planner with noise of a standard deviation on its actions, or the planner itself for 0.

    Raises:
        UsageError: The deviation is negative, or the planner replays the log.
    """
    if not 0.0 <= deviation < math.inf:
        raise UsageError(f"noise is {deviation:g}", cure="use 0 or more")
    if deviation and planner.replays:
        problem = f"planner {planner.name} replays the log, and has no actions to disturb"
        raise UsageError(problem, cure="use expert_actions")
    return Noisy(planner, deviation) if deviation else planner


@record
class SpeedLimited(_Wrapper):
    """A planner that a speed limiter slows down: it perceives and decides as before, and brakes as strongly.

    The limiter lowers the acceleration towards a share of the speed limit of the driven lane within a second, and
    decelerates by at most 2 m/s2 where ego is faster.

    Attributes:
        planner: The planner.
        share: Share of the speed limit, of 13.4 m/s where it is unknown.
        space: Action space.
    """

    planner: Any
    share: float = static()
    space: Physical = static()
    replays: bool = static(default=False)

    @property
    def name(self) -> str:
        """Name of the planner, with the share."""
        return f"{self.planner.name} (limit x {self.share:g})"

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Any:
        """Return the planner's carry."""
        return self.planner.init(bank, state, key)

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return the planner's action, with at most the acceleration of the limiter."""
        action, carry = self.planner.act(carry, bank, state, situation, observation, key)
        limit = situation.surroundings.lanes.limit
        limit = self.share * jnp.where(limit > 0.0, limit, FALLBACK_LIMIT_MPS)
        speed = situation.context.history[-1, MOTION_SPEED]
        limiter_mps2 = jnp.maximum((limit - speed) / _LIMITER_S, -_LIMITER_MPS2)
        unit_mps2 = jnp.where(limiter_mps2 < 0.0, self.space.braking_mps2, self.space.acceleration_mps2)
        largest = limiter_mps2 / unit_mps2
        return action.at[0].set(jnp.where(action[0] > largest, largest, action[0])), carry


def limit_speed(planner: Planner, share: float | None, actions: ActionSpace) -> Planner:
    """Return a planner with a speed limiter at a share of the speed limit, or the planner itself for None.

    Raises:
        UsageError: The share is not positive, the planner replays the log, or its actions are not accelerations.
    """
    if share is None:
        return planner
    if not 0.0 < share < math.inf:
        raise UsageError(f"speed is limited to {share:g} of the limit", cure="use a positive number")
    if planner.replays:
        problem = f"planner {planner.name} replays the log, at the speed of the log"
        raise UsageError(problem, cure="use expert_actions")
    if not isinstance(actions, Physical) or isinstance(actions, Discrete):
        problem = "the action space has no continuous acceleration to limit"
        raise UsageError(problem, cure="use physical, published or route, or leave out --limiter")
    return SpeedLimited(planner, share, actions)


def hold(planner: Planner, steps: int) -> Planner:
    """Return a planner whose decisions are executed for ``steps`` steps."""
    return planner if steps == 1 else Held(planner, steps)
