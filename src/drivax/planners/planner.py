"""The interface of planners: frozen records whose memory travels in their carry."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from drivax.errors import UsageError
from drivax.scenario.bank.scenario_bank import Scalar, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S
from drivax.simulator.types import MOTION_SPEED, Action, SimState, Situation
from drivax.tasks.actions import ActionSpace, Discrete, Physical, action_of

#: Correlation time of the noise on actions, s.
_CORRELATION_S = 1.0


@runtime_checkable
class Planner(Protocol):
    """A driver, unbatched and pure.

    Register implementations as pytrees (weights are leaves, settings are static): evaluation passes the planner as an
    argument of its compiled program. The compiler removes inputs that ``act`` does not read. A planner that needs
    stored scenarios has ``prepare(scenario_of)``, which evaluation calls with a function from a scenario's identity to
    the scenario. A planner that acts on another state than the true one has ``perceive(state)``, which returns it;
    evaluation calls it, wrappers other than :class:`Held` and planners in traffic do not.
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

    @property
    def perceive(self) -> Any:
        """Perception of the planner, if it has one."""
        return self.planner.perceive

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


@record
class Noisy:
    """A planner with noise on its actions: Gaussian, with a correlation time of one second, independent by component.

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

    @property
    def actions(self) -> ActionSpace:
        """Action space of the planner, if it has one of its own."""
        return self.planner.actions

    @property
    def prepare(self) -> Any:
        """Preparation of the planner, if it needs one."""
        return self.planner.prepare

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
    """Return a planner with noise of a standard deviation on its actions; 0: the planner.

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
class SpeedScaled:
    """A planner that drives at another speed: it acts as if its speed were ``speed / scale``.

    On a free road it keeps ``scale * v`` where it would keep the speed v. It brakes as strongly as it decides, because
    a control that drives slower should not react worse; its positive accelerations are scaled. Positions in the
    history are scaled, too, around the present one; ``situation.facts`` and other agents are not.

    Attributes:
        planner: The planner.
        scale: Factor of speeds and of positive accelerations.
    """

    planner: Any
    scale: float = static()
    replays: bool = static(default=False)

    @property
    def name(self) -> str:
        """Name of the planner, with the scale."""
        return f"{self.planner.name} (speed x {self.scale:g})"

    @property
    def actions(self) -> ActionSpace:
        """Action space of the planner, if it has one of its own."""
        return self.planner.actions

    @property
    def prepare(self) -> Any:
        """Preparation of the planner, if it needs one."""
        return self.planner.prepare

    def perceive(self, state: SimState) -> SimState:
        """Return the state with the speeds that the planner acts on."""
        context = state.context
        action, history = context.action, context.history
        xy = history[-1, :2] + (history[:, :2] - history[-1, :2]) / self.scale
        speed = history[:, MOTION_SPEED] / self.scale
        history = history.at[:, :2].set(xy).at[:, MOTION_SPEED].set(speed)
        last = jnp.where(action[0] > 0.0, action[0] / self.scale, action[0])
        context = replace(context, history=history, action=action.at[0].set(last))
        return replace(state, context=context)

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> Any:
        """Return the planner's carry."""
        return self.planner.init(bank, self.perceive(state), key)

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any,
        key: Array,
    ) -> tuple[Action, Any]:  # fmt: skip
        """Return the planner's action in the perceived state, with its acceleration scaled."""
        action, carry = self.planner.act(carry, bank, state, situation, observation, key)
        ahead = action[0]
        scaled = jnp.where(ahead > 0.0, self.scale * jnp.minimum(ahead, 1.0), ahead)
        return action.at[0].set(jnp.where(jnp.isfinite(ahead), scaled, ahead)), carry


def scale_speed(planner: Planner, scale: float, actions: ActionSpace) -> Planner:
    """Return a planner that drives at ``scale`` times its speed; 1: the planner.

    Raises:
        UsageError: The scale is not positive, the planner replays the log, or its actions are no accelerations.
    """
    if scale == 1.0:
        return planner
    if not 0.0 < scale < math.inf:
        raise UsageError(f"speed is scaled by {scale:g}", cure="use a positive number")
    if planner.replays:
        problem = f"planner {planner.name} replays the log, at the speed of the log"
        raise UsageError(problem, cure="use expert_actions")
    if not isinstance(actions, Physical) or isinstance(actions, Discrete):
        problem = "the action space has no continuous acceleration to scale"
        raise UsageError(problem, cure="use physical, published or route, or leave out --speed")
    return SpeedScaled(planner, scale)


def hold(planner: Planner, steps: int) -> Planner:
    """Return a planner whose decisions are executed for ``steps`` steps."""
    return planner if steps == 1 else Held(planner, steps)
